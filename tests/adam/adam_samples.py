"""Random batches of every family on one state, and a small bundle adjustment declared as a stage."""

from __future__ import annotations

import numpy as np
import torch

from uni4d_fg.adam.energy import TorchEnergy
from uni4d_fg.adam.parameters import Parameters
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors import FactorBatch, FactorFamily, Kernel, Slot
from uni4d_fg.factors.arap import ARAP
from uni4d_fg.factors.camera_motion import CAMERA_ROTATION, CAMERA_TRANSLATION
from uni4d_fg.factors.depth_prior import DYNAMIC_DEPTH_PRIOR, STATIC_DEPTH_PRIOR
from uni4d_fg.factors.depth_reprojection import DEPTH_REPROJECTION
from uni4d_fg.factors.dynamic_reprojection import DYNAMIC_REPROJECTION
from uni4d_fg.factors.priors import (
    ASPECT_PRIOR,
    INTRINSICS_PRIOR,
    LOG_SCALE_PRIOR,
    SCALE_ANCHOR,
    difference_linearize,
    difference_residual,
)
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.factors.temporal_smoothness import ACCELERATION_SMOOTHNESS, VELOCITY_SMOOTHNESS
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.graph.problem import Problem, all_free
from uni4d_fg.graph.state import State
from uni4d_fg.stages.stage import Stage

FAMILIES = [
    STATIC_REPROJECTION,
    DYNAMIC_REPROJECTION,
    DEPTH_REPROJECTION,
    STATIC_DEPTH_PRIOR,
    DYNAMIC_DEPTH_PRIOR,
    ARAP,
    VELOCITY_SMOOTHNESS,
    ACCELERATION_SMOOTHNESS,
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    ASPECT_PRIOR,
    INTRINSICS_PRIOR,
    LOG_SCALE_PRIOR,
    SCALE_ANCHOR,
]
FAMILY_IDS = [f"{family.name}-{len(family.variables)}" for family in FAMILIES]
LANDMARK_PRIOR = FactorFamily(
    "landmark_prior", ("landmark",), ("measured",), 3, difference_residual, difference_linearize
)
K = np.array([500.0, 505.0, 320.0, 240.0])
SIZES = {"pose": 6, "intrinsics": 1, "log_scale": 6, "landmark": 9, "dynamic_point": 9}
ROWS = 12


def random_state(rng: np.random.Generator) -> State:
    """Six cameras that look at points, one of them behind the cameras."""
    points = rng.uniform([-1, -1, 2], [1, 1, 5], size=(2, 9, 3))
    points[:, 0, 2] = -1.0
    return State(
        {
            "pose": se3.se3_exp(rng.normal(scale=0.2, size=(6, 6))),
            "intrinsics": K[None],
            "log_scale": rng.normal(scale=0.1, size=(6, 1)),
            "landmark": points[0],
            "dynamic_point": points[1],
        }
    )


def random_batch(
    family: FactorFamily, rng: np.random.Generator, kernel: Kernel, *, unit_sigma: bool = False
) -> FactorBatch:
    """Twelve factors on distinct rows each, with random data, noise and weights."""
    smallest = min((SIZES[g] for g in family.variables if SIZES[g] > 1), default=1)
    rows = np.stack([rng.permutation(smallest) for _ in range(ROWS)])
    slots = tuple(
        Slot(group, rows[:, i] if SIZES[group] > 1 else np.zeros(ROWS, dtype=np.int64))
        for i, group in enumerate(family.variables)
    )
    data = {name: _random_data(name, family, rng) for name in family.data}
    sigma = 1.0 if unit_sigma else rng.uniform(0.5, 2.0, size=(ROWS, family.residual_dim))
    return FactorBatch.create(family, slots, data, sigma=sigma, weight=rng.uniform(size=ROWS), kernel=kernel)


def _random_data(name: str, family: FactorFamily, rng: np.random.Generator) -> np.ndarray:
    if name.startswith("uv"):
        return rng.uniform([0, 0], [640, 480], size=(ROWS, 2))
    if name == "world_T_cam":
        return se3.se3_exp(rng.normal(scale=0.2, size=(ROWS, 6)))
    if name == "intrinsics":
        return np.tile(K, (ROWS, 1))
    if name == "measured":
        if family is ASPECT_PRIOR:
            return rng.normal(scale=0.1, size=ROWS)
        centre = K if family is INTRINSICS_PRIOR else np.zeros(family.residual_dim)
        return centre + rng.normal(scale=0.5, size=(ROWS, family.residual_dim))
    if name in ("floor", "log_scale"):
        return np.full(ROWS, 1e-3)
    return rng.uniform(1.0, 4.0, size=ROWS)


def torch_parameters(problem: Problem, state: State) -> tuple[Parameters, TorchEnergy]:
    """The problem's free variables and energy in double precision."""
    parameters = Parameters.create(torch, state, problem.free, torch.float64, "cpu")
    return parameters, TorchEnergy(torch, problem.batches, state, parameters.moving, torch.float64, "cpu")


def small_bundle(
    rng: np.random.Generator, *, kernel: Kernel | None = None, name: str = "bundle_adjustment"
) -> tuple[Stage, State]:
    """Four cameras and ten landmarks with weak priors on the landmarks; frame 0 and the principal point are held."""
    poses = se3.se3_exp(np.arange(4)[:, None] * np.array([0.01, 0.03, 0.0, 0.15, 0.02, 0.02]))
    landmarks = rng.uniform([-1.2, -0.9, 2.5], [1.6, 0.9, 5.0], size=(10, 3))
    frame, row = np.divmod(np.arange(40), 10)
    uv = project(K, world_to_camera(poses[frame], landmarks[row])) + rng.normal(scale=0.3, size=(40, 2))
    shared = Slot("intrinsics", np.zeros(40, dtype=np.int64))
    batches = (
        FactorBatch.create(
            STATIC_REPROJECTION,
            (Slot("pose", frame), Slot("landmark", row), shared),
            {"uv": uv},
            weight=1.0 / 40,
            kernel=kernel,
        ),
        FactorBatch.create(
            LANDMARK_PRIOR, (Slot("landmark", np.arange(10)),), {"measured": landmarks}, sigma=0.2, weight=0.1
        ),
    )
    state = State(
        {
            "pose": poses.copy(),
            "intrinsics": K[None].copy(),
            "landmark": landmarks + rng.normal(scale=0.05, size=landmarks.shape),
        }
    )
    moved = se3.retract(poses, rng.normal(scale=0.01, size=(4, 6)))
    state = state.replace(pose=np.concatenate([poses[:1], moved[1:]]))
    free = all_free(state, "pose", "intrinsics", "landmark")
    free["pose"][0] = False
    free["intrinsics"][0, 2:] = False
    return Stage(name, batches, free, SolverConfig(max_iterations=60), eliminate="landmark"), state
