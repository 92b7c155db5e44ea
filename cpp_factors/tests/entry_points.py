"""Every entry point of the extension that takes arrays, with valid arguments to start from.

An entry is a function of named arguments and a maker of valid ones. `test_boundary.py` spoils one argument at a
time. Every factor type is here without being named; any other new entry point is covered by adding a line.
`LandmarkSystem` has tests of the same kind of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from families import TYPES, arguments_of, split_arguments
from uni4d_fg_cpp import _core


@dataclass(frozen=True)
class EntryPoint:
    """A callable and how to make valid keyword arguments for it; only the arrays among them are spoilt."""

    call: Callable[..., Any]
    make: Callable[[np.random.Generator], dict[str, Any]]
    negative: tuple[str, ...] = ()
    """Float arguments for which a negative value must be refused."""
    open_values: tuple[str, ...] = ()
    """Float arguments that may have values that are not finite: they are missing."""


def _noise(rng: np.random.Generator, count: int) -> dict[str, Any]:
    return {"sigma": rng.uniform(0.5, 2, count), "weight": rng.uniform(0, 2, count), "kernel": 1, "threshold": 1.3}


def _of_type(name: str, suffix: str) -> EntryPoint:
    """Return the entry by name; `<name>_<suffix>` checks its arguments in the same place."""

    def call(**arguments: Any) -> Any:
        return getattr(_core, suffix)(name, *split_arguments(name, arguments))

    return EntryPoint(call, lambda rng: arguments_of(name, rng, 5), tuple(TYPES[name]["positive"]))


ENTRY_POINTS: dict[str, EntryPoint] = {
    f"{name}_{suffix}": _of_type(name, suffix) for name in TYPES for suffix in ("residual", "linearize")
}
ENTRY_POINTS["robust_energy"] = EntryPoint(
    _core.robust_energy, lambda rng: {"residual": rng.normal(size=(5, 3)), **_noise(rng, 5)}, ("sigma", "weight")
)
ENTRY_POINTS["whiten"] = EntryPoint(
    lambda residual, jacobians, **noise: _core.whiten(residual, [jacobians], **noise),
    lambda rng: {"residual": rng.normal(size=(5, 3)), "jacobians": rng.normal(size=(5, 3, 6)), **_noise(rng, 5)},
    ("sigma", "weight"),
)


def _patches(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "rows": np.arange(5),
        "image": rng.integers(0, 255, (30, 40), dtype=np.uint8),
        "warp": np.concatenate([rng.uniform(10, 20, (5, 2)), np.tile([1.0, 0, 0, 1], (5, 1))], axis=1),
        "weight": np.ones((7, 7)),
        "stiffness": 2.0,
        "max_iterations": 4,
        "convergence_px": 0.01,
    }


ENTRY_POINTS["register_patches"] = EntryPoint(
    lambda **a: _core.register_patches(np.random.default_rng(0).uniform(0, 255, (5, 9, 9)).astype(np.float32), **a),
    _patches,
    ("weight",),
)

ENTRY_POINTS["compare_frames"] = EntryPoint(
    lambda **a: _core.compare_frames(np.ones((4, 5), np.float32), [np.ones((4, 5), np.float32)] * 2, **a),
    lambda rng: {"turns": rng.normal(size=(2, 3, 3)), "shifts": rng.normal(size=(2, 3)), "agree": 1.1, "alike": 1.1},
)


def _rays(rng: np.random.Generator) -> dict[str, Any]:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(4, 3))
    return {
        "row": np.array([0, 0, 1, 1, 2]),
        "frame": np.array([0, 3, 1, 2, 0]),
        "uv": rng.uniform(0, 600, (5, 2)),
        "world_T_cam": poses,
        "intrinsics": rng.uniform(200, 900, 4),
    }


def _points(rng: np.random.Generator) -> dict[str, Any]:
    return {**_rays(rng), "position": rng.normal(size=(3, 3)) + np.array([0.0, 0.0, 5.0])}


_REFINING = {"huber_px": 1.0, "steps": 3, "converged": 1e-5, "ridge": 1e-9}
ENTRY_POINTS |= {
    "ray_equations": EntryPoint(lambda **arguments: _core.ray_equations(**arguments, tracks=3), _rays),
    "refine_points": EntryPoint(
        lambda **arguments: _core.refine_points(**arguments, **_REFINING),
        lambda rng: {**_points(rng), "origin": rng.normal(size=(4, 3))},
        open_values=("position",),
    ),
    "ray_angles": EntryPoint(_core.ray_angles, _points, open_values=("position",)),
    "reprojection_errors": EntryPoint(_core.reprojection_errors, _points, open_values=("position",)),
}


def _pairs(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "source": np.array([0, 0, 1, 2, 2]),
        "target": np.array([1, 2, 0, 0, 1]),
        "uv_source": rng.uniform(0, 600, (5, 2)),
        "depth": rng.uniform(1, 5, 5),
        "uv_target": rng.uniform(0, 600, (5, 2)),
        **_noise(rng, 5),
        "pose_columns": np.arange(18).reshape(3, 6),
        "intrinsics_columns": np.array([18, 19, -1, -1]),
    }


def _state_of_pairs(rng: np.random.Generator) -> dict[str, Any]:
    return {"poses": arguments_of("camera_rotation", rng, 3)["now"], "intrinsics": rng.uniform(200, 900, 4)}


_PAIR_SYSTEM = _core.PairSystem(**_pairs(np.random.default_rng(0)), size=20)

ENTRY_POINTS["PairSystem"] = EntryPoint(
    lambda **arguments: _core.PairSystem(**arguments, size=20), _pairs, ("sigma", "weight")
)
ENTRY_POINTS["PairSystem.energy"] = EntryPoint(_PAIR_SYSTEM.energy, _state_of_pairs)
ENTRY_POINTS["PairSystem.linearize"] = EntryPoint(_PAIR_SYSTEM.linearize, _state_of_pairs)


def _trajectory(method: str, slots: int, fields: dict[str, tuple[int, ...]]) -> EntryPoint:
    """Return the entry of one kind of batch on a system of three tracks; rows stand as "rows[0]", "rows[1]", ..."""

    def call(**arguments: Any) -> None:
        rows = [arguments.pop(f"rows[{i}]") for i in range(slots)]
        getattr(_core.TrajectorySystem(np.repeat(np.arange(3), 5)), method)(rows=rows, **arguments)

    def make(rng: np.random.Generator) -> dict[str, Any]:
        data = {name: rng.uniform(1, 5, (4, *shape)) for name, shape in fields.items()}
        return {**{f"rows[{i}]": np.arange(4) + i for i in range(slots)}, **data, **_noise(rng, 4)}

    return EntryPoint(call, make, ("sigma", "weight", *(["depth"] if "depth" in fields else [])))


_CAMERA = {"world_T_cam": (4, 4)}
_TRAJECTORIES = _core.TrajectorySystem(np.repeat(np.arange(3), 5))
_TRAJECTORIES.plan()
_TRAJECTORIES.linearize(np.zeros((15, 3)))

ENTRY_POINTS |= {
    f"TrajectorySystem.{name}": entry
    for name, entry in {
        "add_dynamic_reprojection": _trajectory(
            "add_dynamic_reprojection", 1, {"uv": (2,), **_CAMERA, "intrinsics": (4,)}
        ),
        "add_dynamic_depth_prior": _trajectory("add_dynamic_depth_prior", 1, {"depth": (), **_CAMERA, "log_scale": ()}),
        "add_smoothness": _trajectory("add_smoothness", 3, {}),
        "add_arap": _trajectory("add_arap", 4, {}),
        "multiply": EntryPoint(_TRAJECTORIES.multiply, lambda rng: {"vector": rng.normal(size=45)}),
    }.items()
}
