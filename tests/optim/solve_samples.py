"""Small problems with known structure, GTSAM's native form of one of them, and dense reference algebra."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from uni4d_fg.arrays import Array
from uni4d_fg.factors import FactorBatch, FactorType, Kernel, Slot, VariableType
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.depth_prior import dynamic_depth_prior, static_depth_prior
from uni4d_fg.factors.depth_reprojection import depth_reprojection
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection
from uni4d_fg.factors.priors import difference_jacobian, intrinsics_prior, log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, LOG_SCALE, POSE, ZOOM
from uni4d_fg.factors.zoom import zoom_smoothness, zoomed_reprojection
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.optim.problem import Problem, all_free

Sample = tuple[Problem, State]
K = np.array([500.0, 505.0, 320.0, 240.0])


def prior_type(name: str, variable: VariableType) -> FactorType:
    """A prior on a vector; not listed, so that other samples may have one of the same name."""
    dim = variable.dim
    return FactorType(name, (variable,), {"measured": (dim,)}, dim, difference, difference_jacobian, listed=False)


def difference(variable: Array, *, measured: Array) -> Array:
    return variable - measured


LANDMARK_PRIOR = prior_type("landmark_prior", LANDMARK)
POINT_PRIOR = prior_type("point_prior", DYNAMIC_POINT)


def camera_path(count: int) -> np.ndarray:
    t = np.arange(count)
    xi = np.stack([0.01 * t, 0.03 * t, 0 * t, 0.15 * t, 0.05 * np.sin(t), 0.02 * t], axis=1)
    return se3.se3_exp(xi)


def bundle(
    rng: np.random.Generator,
    num_poses: int = 5,
    num_landmarks: int = 24,
    *,
    kernel: Kernel | None = None,
    outliers: int = 0,
    depth: bool = False,
) -> tuple[Problem, State]:
    """A bundle adjustment whose gauge is held by weak priors on landmarks; everything free; disturbed start."""
    poses = camera_path(num_poses)
    landmarks = rng.uniform([-1.2, -0.9, 2.5], [1.6, 0.9, 5.0], size=(num_landmarks, 3))
    frame, row = np.divmod(np.arange(num_poses * num_landmarks), num_landmarks)
    seen = rng.uniform(size=len(row)) < 0.8
    frame, row = frame[seen], row[seen]
    x = world_to_camera(poses[frame], landmarks[row])
    uv = project(K, x) + rng.normal(scale=0.5, size=(len(row), 2))
    wrong = rng.choice(len(row), outliers, replace=False)
    uv[wrong] += rng.normal(scale=30.0, size=(outliers, 2))
    shared = np.zeros(len(row), dtype=np.int64)
    batches = [
        FactorBatch.create(
            static_reprojection,
            (Slot(POSE, frame), Slot(LANDMARK, row), Slot(INTRINSICS, shared)),
            {"uv": uv},
            sigma=0.5,
            kernel=kernel,
        ),
        FactorBatch.create(
            LANDMARK_PRIOR,
            (Slot(LANDMARK, np.arange(num_landmarks)),),
            {"measured": landmarks + rng.normal(scale=0.02, size=landmarks.shape)},
            sigma=0.05,
        ),
        FactorBatch.create(
            intrinsics_prior, (Slot(INTRINSICS, np.zeros(1, dtype=np.int64)),), {"measured": K[None]}, sigma=5.0
        ),
    ]
    arrays = {
        POSE: se3.retract(poses, rng.normal(scale=0.02, size=(num_poses, 6))),
        INTRINSICS: K[None] * 1.02,
        LANDMARK: landmarks + rng.normal(scale=0.1, size=landmarks.shape),
    }
    if depth:
        batches += depth_terms(rng, poses, x, frame, row)
        arrays[LOG_SCALE] = np.zeros((num_poses, 1))
    state = State(arrays, {LANDMARK: 10 + 3 * np.arange(num_landmarks)})
    return Problem(tuple(batches), all_free(state, *arrays)), state


def depth_terms(
    rng: np.random.Generator, poses: np.ndarray, x: np.ndarray, frame: np.ndarray, row: np.ndarray
) -> list[FactorBatch]:
    cue = x[:, 2] * np.exp(rng.normal(scale=0.02, size=len(x)))
    slots = (Slot(POSE, frame), Slot(LANDMARK, row), Slot(LOG_SCALE, frame))
    scales = Slot(LOG_SCALE, np.arange(len(poses)))
    return [
        FactorBatch.create(static_depth_prior, slots, {"depth": cue}, sigma=0.02, kernel=Kernel("cauchy", 2.0)),
        FactorBatch.create(log_scale_prior, (scales,), {"measured": np.zeros((len(poses), 1))}, sigma=0.05),
    ]


def pair_terms(rng: np.random.Generator, num_poses: int, count: int, same: bool) -> FactorBatch:
    """Depth reprojection between pairs of poses; ``same`` puts some factors' two poses on one row."""
    poses = camera_path(num_poses)
    source = rng.integers(0, num_poses, count)
    target = (source + rng.integers(1, num_poses, count)) % num_poses
    if same:
        target[:3] = source[:3]
    x = rng.uniform([-0.8, -0.6, 2.0], [0.8, 0.6, 4.0], size=(count, 3))
    moved = world_to_camera(poses[target], camera_to_world(poses[source], x))
    return FactorBatch.create(
        depth_reprojection,
        (Slot(POSE, source), Slot(POSE, target), Slot(INTRINSICS, np.zeros(count, dtype=np.int64))),
        {
            "uv_source": project(K, x),
            "depth": x[:, 2],
            "uv_target": project(K, moved) + rng.normal(scale=0.5, size=(count, 2)),
        },
        kernel=Kernel("huber", 1.5),
    )


def native_bundle(
    problem: Problem, state: State, huber: float | None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The same bundle adjustment from GTSAM's own factors; its Cal3_S2 has a skew, held at zero by a prior."""
    graph = gtsam.NonlinearFactorGraph()
    reprojection, landmark_prior, _ = problem.batches
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    if huber is not None:
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(huber), noise)
    for n in range(len(reprojection)):
        pose, landmark, intrinsics = (state.key(s.variable, int(s.rows[n])) for s in reprojection.slots)
        uv = reprojection.data["uv"][n]
        graph.push_back(gtsam.GeneralSFMFactor2Cal3_S2(uv, noise, pose, landmark, intrinsics))
    point_noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.05)
    for n, measured in enumerate(landmark_prior.data["measured"]):
        graph.push_back(gtsam.PriorFactorPoint3(state.key(LANDMARK, n), measured, point_noise))
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([5.0, 5.0, 1e-9, 5.0, 5.0]))
    fx, fy, cx, cy = K
    graph.push_back(gtsam.PriorFactorCal3_S2(INTRINSICS.key(0), gtsam.Cal3_S2(fx, fy, 0.0, cx, cy), sigmas))
    return graph, state.to_values()


def trajectories(
    rng: np.random.Generator, num_tracks: int = 6, num_frames: int = 7, *, kernel: Kernel | None = None
) -> tuple[Problem, State]:
    """A non-rigid problem: reprojection, depth prior, acceleration and as-rigid-as-possible on a moving body."""
    kernel = kernel or Kernel("huber", 1.345)
    body = rng.normal(scale=[0.4, 0.4, 0.15], size=(num_tracks, 3))
    t = np.arange(num_frames)
    motion = se3.se3_exp(np.stack([0 * t, 0.05 * t, 0.01 * t, 0.06 * t, 0 * t, 0.02 * t], axis=1))
    points = np.einsum("tij,mj->mti", motion[:, :3, :3], body) + motion[None, :, :3, 3] + [0.0, 0.0, 3.0]
    flat = points.reshape(-1, 3)
    frame, track = np.tile(t, num_tracks), np.repeat(np.arange(num_tracks), num_frames)
    poses = camera_path(num_frames)[frame]
    x = world_to_camera(poses, flat)
    intrinsics = np.broadcast_to(K, (len(flat), 4))
    uv = project(intrinsics, x) + rng.normal(scale=0.7, size=(len(flat), 2))
    depth = x[:, 2] * np.exp(rng.normal(scale=0.02, size=len(flat)))
    row = np.arange(len(flat)).reshape(num_tracks, num_frames)
    own = (slot(row),)
    k, m = np.triu_indices(num_tracks, 1)
    nearest = np.argsort(np.linalg.norm(body[k] - body[m], axis=1), kind="stable")[: (len(k) + 1) // 2]
    k, m = k[nearest], m[nearest]
    batches = (
        FactorBatch.create(
            dynamic_reprojection,
            own,
            {"uv": uv, "world_T_cam": poses, "intrinsics": intrinsics},
            sigma=0.7,
            kernel=kernel,
        ),
        FactorBatch.create(
            dynamic_depth_prior,
            own,
            {"depth": depth, "world_T_cam": poses, "log_scale": np.zeros(len(flat))},
            sigma=0.02,
            kernel=kernel,
        ),
        FactorBatch.create(
            acceleration_smoothness,
            tuple(slot(row[:, i : num_frames - 2 + i]) for i in range(3)),
            sigma=0.004,
            kernel=kernel,
        ),
        FactorBatch.create(
            arap,
            (slot(row[k, :-1]), slot(row[m, :-1]), slot(row[k, 1:]), slot(row[m, 1:])),
            sigma=0.01,
            kernel=kernel,
        ),
    )
    start = camera_to_world(poses, unproject(intrinsics, uv, depth))
    state = State({DYNAMIC_POINT: start}, {DYNAMIC_POINT: np.stack([10 * track, frame], axis=1)})
    return Problem(batches, all_free(state, DYNAMIC_POINT)), state


def slot(rows: np.ndarray) -> Slot:
    return Slot(DYNAMIC_POINT, rows.reshape(-1))


def dense_jacobian(
    problem: Problem, state: State, groups: list[VariableType]
) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """Return the full J over every entry of the groups, r, and the first column of each group."""
    offset, size = {}, 0
    for group in groups:
        offset[group] = size
        size += len(state[group]) * group.dim
    blocks, residuals = [], []
    for batch in problem.batches:
        r, jacobians = batch.linearize(state)
        n, d = r.shape
        full = np.zeros((n, d, size))
        for s, jacobian in zip(batch.slots, jacobians, strict=True):
            if s.variable not in offset:
                continue
            dim = s.variable.dim
            for i in range(n):
                start = offset[s.variable] + int(s.rows[i]) * dim
                full[i, :, start : start + dim] += jacobian[i]
        blocks.append(full.reshape(n * d, size))
        residuals.append(r.reshape(-1))
    return np.concatenate(blocks), np.concatenate(residuals), offset


def free_mask(problem: Problem, state: State, groups: list[VariableType]) -> np.ndarray:
    """Return which of the columns of :func:`dense_jacobian` may move."""
    masks = []
    for group in groups:
        shape = (len(state[group]), group.dim)
        masks.append(np.asarray(problem.free.get(group, np.zeros(shape, dtype=bool))).reshape(-1))
    return np.concatenate(masks)


def through_a_lens(sample: Sample, kind: FactorType) -> Sample:
    """Every observation through a lens, whose second parameter is held at zero."""
    problem, state = sample
    variable, free = kind.variables[2], dict(problem.free)
    arrays = {v: array for v, array in state.arrays.items() if v is not INTRINSICS}
    camera = np.concatenate([state[INTRINSICS], [[-0.1, 0.0, 1e-3, -1e-3]]], axis=1)
    del free[INTRINSICS]
    free[variable] = np.array([[True] * 5 + [False] + [True] * 2])
    first, *others = (b for b in problem.batches if b.factor_type is not intrinsics_prior)
    camera_slot = Slot(variable, np.zeros(len(first), dtype=np.int64))
    lens = replace(first, factor_type=kind, slots=(*first.slots[:2], camera_slot))
    return replace(problem, batches=(lens, *others), free=free), State({variable: camera, **arrays}, state.index)


def zooming(sample: Sample, *, with_depth: bool = True) -> Sample:
    """Every frame with a focal length of its own, that of the first held; without depth no log-scale is left."""
    problem, state = sample
    count = len(state[POSE])
    zoom = np.random.default_rng(1).normal(scale=0.05, size=(count, 1))
    free = {**problem.free, ZOOM: np.arange(count)[:, None] > 0}
    arrays = {**state.arrays, ZOOM: zoom}
    first, *others = problem.batches
    if not with_depth:
        del free[LOG_SCALE], arrays[LOG_SCALE]
        others = [batch for batch in others if all(slot.variable is not LOG_SCALE for slot in batch.slots)]
    zoomed = replace(first, factor_type=zoomed_reprojection, slots=(*first.slots, Slot(ZOOM, first.slots[0].rows)))
    rows = np.arange(count - 1)
    smooth = FactorBatch.create(zoom_smoothness, (Slot(ZOOM, rows), Slot(ZOOM, rows + 1)), sigma=0.05)
    return replace(problem, batches=(zoomed, *others, smooth), free=free), State(arrays, state.index)
