"""Random batches of every family on one state, and a small bundle adjustment declared as a stage."""

from __future__ import annotations

import numpy as np
import torch

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors import FactorBatch, FactorType, Kernel, Slot
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.camera_motion import camera_rotation, camera_translation, relative_camera_translation
from uni4d_fg.factors.depth_prior import dynamic_depth_prior, static_depth_prior
from uni4d_fg.factors.depth_reprojection import depth_reprojection
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection
from uni4d_fg.factors.priors import (
    aspect_prior,
    difference_jacobian,
    intrinsics_prior,
    log_scale_prior,
    scale_anchor,
)
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness, velocity_smoothness
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.optim.adam.energy import TorchEnergy
from uni4d_fg.optim.adam.parameters import Parameters
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.stage import Stage

FAMILIES = [
    static_reprojection,
    dynamic_reprojection,
    depth_reprojection,
    static_depth_prior,
    dynamic_depth_prior,
    arap,
    velocity_smoothness,
    acceleration_smoothness,
    camera_rotation,
    camera_translation,
    relative_camera_translation,
    aspect_prior,
    intrinsics_prior,
    log_scale_prior,
    scale_anchor,
]
FAMILY_IDS = [f"{family.name}-{len(family.variables)}" for family in FAMILIES]
LANDMARK_PRIOR = FactorType(
    "landmark_prior", (LANDMARK,), {"measured": (3,)}, 3, lambda p, *, measured: p - measured, difference_jacobian,
    listed=False,
)  # fmt: skip
K = np.array([500.0, 505.0, 320.0, 240.0])
SIZES = {POSE: 6, INTRINSICS: 1, LOG_SCALE: 6, LANDMARK: 9, DYNAMIC_POINT: 9}
ROWS = 12


def random_state(rng: np.random.Generator) -> State:
    """Six cameras that look at points, one of them behind the cameras."""
    points = rng.uniform([-1, -1, 2], [1, 1, 5], size=(2, 9, 3))
    points[:, 0, 2] = -1.0
    return State(
        {
            POSE: se3.se3_exp(rng.normal(scale=0.2, size=(6, 6))),
            INTRINSICS: K[None],
            LOG_SCALE: rng.normal(scale=0.1, size=(6, 1)),
            LANDMARK: points[0],
            DYNAMIC_POINT: points[1],
        }
    )


def random_batch(
    family: FactorType, rng: np.random.Generator, kernel: Kernel, *, unit_sigma: bool = False
) -> FactorBatch:
    """Twelve factors on distinct rows each, with random data, noise and weights."""
    smallest = min((SIZES[g] for g in family.variables if SIZES[g] > 1), default=1)
    rows = np.stack([rng.permutation(smallest) for _ in range(ROWS)])
    slots = tuple(
        Slot(group, rows[:, i] if SIZES[group] > 1 else np.zeros(ROWS, dtype=np.int64))
        for i, group in enumerate(family.variables)
    )
    data = {name: _random_data(name, family, rng) for name in family.data}
    sigma = 1.0 if unit_sigma else rng.uniform(0.5, 2.0, size=(ROWS, family.dim))
    return FactorBatch.create(family, slots, data, sigma=sigma, weight=rng.uniform(size=ROWS), kernel=kernel)


def _random_data(name: str, family: FactorType, rng: np.random.Generator) -> np.ndarray:
    if name.startswith("uv"):
        return rng.uniform([0, 0], [640, 480], size=(ROWS, 2))
    if name == "world_T_cam":
        return se3.se3_exp(rng.normal(scale=0.2, size=(ROWS, 6)))
    if name == "intrinsics":
        return np.tile(K, (ROWS, 1))
    if name == "measured":
        if family is aspect_prior:
            return rng.normal(scale=0.1, size=ROWS)
        center = K if family is intrinsics_prior else np.zeros(family.dim)
        return center + rng.normal(scale=0.5, size=(ROWS, family.dim))
    if name in ("floor", "log_scale"):
        return np.full(ROWS, 1e-3)
    return rng.uniform(1.0, 4.0, size=ROWS)


def torch_parameters(problem: Problem, state: State) -> tuple[Parameters, TorchEnergy]:
    """The problem's free variables and energy in double precision."""
    parameters = Parameters.create(torch, state, problem.free, torch.float64, "cpu")
    return parameters, TorchEnergy(torch, problem.batches, state, parameters.moving, torch.float64, "cpu")


def small_bundle(
    rng: np.random.Generator, *, kernel: Kernel | None = None, kind: str = "bundle_adjustment"
) -> tuple[Stage, State]:
    """Four cameras and ten landmarks with weak priors on the landmarks; frame 0 and the principal point are held."""
    poses = se3.se3_exp(np.arange(4)[:, None] * np.array([0.01, 0.03, 0.0, 0.15, 0.02, 0.02]))
    landmarks = rng.uniform([-1.2, -0.9, 2.5], [1.6, 0.9, 5.0], size=(10, 3))
    frame, row = np.divmod(np.arange(40), 10)
    uv = project(K, world_to_camera(poses[frame], landmarks[row])) + rng.normal(scale=0.3, size=(40, 2))
    shared = Slot(INTRINSICS, np.zeros(40, dtype=np.int64))
    batches = (
        FactorBatch.create(
            static_reprojection,
            (Slot(POSE, frame), Slot(LANDMARK, row), shared),
            {"uv": uv},
            weight=1.0 / 40,
            kernel=kernel,
        ),
        FactorBatch.create(
            LANDMARK_PRIOR, (Slot(LANDMARK, np.arange(10)),), {"measured": landmarks}, sigma=0.2, weight=0.1
        ),
    )
    state = State(
        {
            POSE: poses.copy(),
            INTRINSICS: K[None].copy(),
            LANDMARK: landmarks + rng.normal(scale=0.05, size=landmarks.shape),
        }
    )
    moved = se3.retract(poses, rng.normal(scale=0.01, size=(4, 6)))
    state = state.replace({POSE: np.concatenate([poses[:1], moved[1:]])})
    free = all_free(state, POSE, INTRINSICS, LANDMARK)
    free[POSE][0] = False
    free[INTRINSICS][0, 2:] = False
    return Stage(kind, Problem(batches, free, LANDMARK), SolverConfig(max_iterations=60)), state
