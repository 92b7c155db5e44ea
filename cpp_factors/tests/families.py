"""Random arguments of every factor family, and its NumPy and C++ implementations."""

from __future__ import annotations

import numpy as np

from uni4d_fg.factors.arap import ARAP
from uni4d_fg.factors.camera_motion import CAMERA_ROTATION, CAMERA_TRANSLATION
from uni4d_fg.factors.depth_prior import DYNAMIC_DEPTH_PRIOR, STATIC_DEPTH_PRIOR
from uni4d_fg.factors.depth_reprojection import DEPTH_REPROJECTION
from uni4d_fg.factors.dynamic_reprojection import DYNAMIC_REPROJECTION
from uni4d_fg.factors.family import FactorFamily
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.factors.temporal_smoothness import ACCELERATION_SMOOTHNESS, VELOCITY_SMOOTHNESS
from uni4d_fg.geometry import se3

FAMILIES: dict[str, FactorFamily] = {
    "depth_reprojection": DEPTH_REPROJECTION,
    "static_reprojection": STATIC_REPROJECTION,
    "dynamic_reprojection": DYNAMIC_REPROJECTION,
    "camera_rotation": CAMERA_ROTATION,
    "camera_translation": CAMERA_TRANSLATION,
    "arap": ARAP,
    "velocity_smoothness": VELOCITY_SMOOTHNESS,
    "acceleration_smoothness": ACCELERATION_SMOOTHNESS,
    "static_depth_prior": STATIC_DEPTH_PRIOR,
    "dynamic_depth_prior": DYNAMIC_DEPTH_PRIOR,
}

VARIABLE_NAMES = {
    "depth_reprojection": ("source_pose", "target_pose", "intrinsics"),
    "static_reprojection": ("world_T_cam", "landmark", "intrinsics"),
    "dynamic_reprojection": ("dynamic_point",),
    "camera_rotation": ("before", "now", "after"),
    "camera_translation": ("before", "now", "after"),
    "arap": ("first", "second", "first_next", "second_next"),
    "velocity_smoothness": ("now", "after"),
    "acceleration_smoothness": ("before", "now", "after"),
    "static_depth_prior": ("world_T_cam", "landmark", "log_scale"),
    "dynamic_depth_prior": ("dynamic_point",),
}


def arguments_of(name: str, rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
    """Return every argument of a family by name, variables first."""

    def poses() -> np.ndarray:
        return se3.se3_exp(rng.normal(size=(count, 6)) * np.array([0.4, 0.4, 0.4, 1.0, 1.0, 1.0]))

    def points() -> np.ndarray:
        return rng.normal(size=(count, 3)) * 2.0 + np.array([0.0, 0.0, 3.0])

    def intrinsics() -> np.ndarray:
        return np.stack([rng.uniform(200, 900, count) for _ in range(4)], axis=1)

    makers = {
        "uv": lambda: rng.uniform(0, 600, (count, 2)),
        "depth": lambda: rng.uniform(0.3, 9, count),
        "floor": lambda: rng.uniform(1e-4, 1e-2, count),
        "log_scale": lambda: rng.normal(size=count if name == "dynamic_depth_prior" else (count, 1)),
        "intrinsics": intrinsics,
        "uv_source": lambda: rng.uniform(0, 600, (count, 2)),
        "uv_target": lambda: rng.uniform(0, 600, (count, 2)),
    }
    family = FAMILIES[name]
    out = {}
    for variable, group in zip(VARIABLE_NAMES[name], family.variables, strict=True):
        default = poses if group == "pose" else points
        out[variable] = makers.get(variable, default)()
    for data in family.data:
        out[data] = makers.get(data, poses)()
    return out


def split_arguments(name: str, arguments: dict[str, np.ndarray]) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
    """Return the variables as positional arguments and the data by name."""
    names = VARIABLE_NAMES[name]
    return [arguments[n] for n in names], {n: a for n, a in arguments.items() if n not in names}
