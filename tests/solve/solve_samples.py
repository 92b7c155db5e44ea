"""Small problems with known structure, GTSAM's native form of one of them, and dense reference algebra."""

from __future__ import annotations

import gtsam
import numpy as np

from uni4d_fg.factors import FactorBatch, FactorFamily, Kernel, Slot
from uni4d_fg.factors.arap import ARAP
from uni4d_fg.factors.depth_prior import DYNAMIC_DEPTH_PRIOR, STATIC_DEPTH_PRIOR
from uni4d_fg.factors.depth_reprojection import DEPTH_REPROJECTION
from uni4d_fg.factors.dynamic_reprojection import DYNAMIC_REPROJECTION
from uni4d_fg.factors.priors import INTRINSICS_PRIOR, LOG_SCALE_PRIOR, difference_linearize, difference_residual
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.factors.temporal_smoothness import ACCELERATION_SMOOTHNESS
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.graph import keys
from uni4d_fg.graph.problem import Problem, all_free
from uni4d_fg.graph.state import TANGENT_DIM, State, VariableNames

K = np.array([500.0, 505.0, 320.0, 240.0])

LANDMARK_PRIOR = FactorFamily(
    "landmark_prior", ("landmark",), ("measured",), 3, difference_residual, difference_linearize
)
POINT_PRIOR = FactorFamily(
    "point_prior", ("dynamic_point",), ("measured",), 3, difference_residual, difference_linearize
)


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
            STATIC_REPROJECTION,
            (Slot("pose", frame), Slot("landmark", row), Slot("intrinsics", shared)),
            {"uv": uv},
            sigma=0.5,
            kernel=kernel,
        ),
        FactorBatch.create(
            LANDMARK_PRIOR,
            (Slot("landmark", np.arange(num_landmarks)),),
            {"measured": landmarks + rng.normal(scale=0.02, size=landmarks.shape)},
            sigma=0.05,
        ),
        FactorBatch.create(
            INTRINSICS_PRIOR, (Slot("intrinsics", np.zeros(1, dtype=np.int64)),), {"measured": K[None]}, sigma=5.0
        ),
    ]
    groups = {
        "pose": se3.retract(poses, rng.normal(scale=0.02, size=(num_poses, 6))),
        "intrinsics": K[None] * 1.02,
        "landmark": landmarks + rng.normal(scale=0.1, size=landmarks.shape),
    }
    if depth:
        batches += depth_terms(rng, poses, x, frame, row)
        groups["log_scale"] = np.zeros((num_poses, 1))
    state = State(groups, VariableNames(landmark_track=10 + 3 * np.arange(num_landmarks)))
    return Problem(tuple(batches), all_free(state, *groups)), state


def depth_terms(
    rng: np.random.Generator, poses: np.ndarray, x: np.ndarray, frame: np.ndarray, row: np.ndarray
) -> list[FactorBatch]:
    cue = x[:, 2] * np.exp(rng.normal(scale=0.02, size=len(x)))
    slots = (Slot("pose", frame), Slot("landmark", row), Slot("log_scale", frame))
    scales = Slot("log_scale", np.arange(len(poses)))
    return [
        FactorBatch.create(STATIC_DEPTH_PRIOR, slots, {"depth": cue}, sigma=0.02, kernel=Kernel("cauchy", 2.0)),
        FactorBatch.create(LOG_SCALE_PRIOR, (scales,), {"measured": np.zeros((len(poses), 1))}, sigma=0.05),
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
        DEPTH_REPROJECTION,
        (Slot("pose", source), Slot("pose", target), Slot("intrinsics", np.zeros(count, dtype=np.int64))),
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
        pose, landmark, intrinsics = (state.key(s.group, int(s.rows[n])) for s in reprojection.slots)
        uv = reprojection.data["uv"][n]
        graph.push_back(gtsam.GeneralSFMFactor2Cal3_S2(uv, noise, pose, landmark, intrinsics))
    point_noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.05)
    for n, measured in enumerate(landmark_prior.data["measured"]):
        graph.push_back(gtsam.PriorFactorPoint3(state.key("landmark", n), measured, point_noise))
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([5.0, 5.0, 1e-9, 5.0, 5.0]))
    graph.push_back(gtsam.PriorFactorCal3_S2(keys.intrinsics_key(), calibration(K), sigmas))
    values = state.to_values()
    values.erase(keys.intrinsics_key())
    values.insert(keys.intrinsics_key(), calibration(state["intrinsics"][0]))
    return graph, values


def calibration(intrinsics: np.ndarray) -> gtsam.Cal3_S2:
    fx, fy, cx, cy = intrinsics
    return gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)


def from_native(values: gtsam.Values, state: State) -> State:
    """Read a native solution back into our groups."""
    cal = values.atCal3_S2(keys.intrinsics_key())
    without = gtsam.Values(values)
    without.erase(keys.intrinsics_key())
    return state.with_values(without).replace(intrinsics=np.array([[cal.fx(), cal.fy(), cal.px(), cal.py()]]))


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
            DYNAMIC_REPROJECTION,
            own,
            {"uv": uv, "world_T_cam": poses, "intrinsics": intrinsics},
            sigma=0.7,
            kernel=kernel,
        ),
        FactorBatch.create(
            DYNAMIC_DEPTH_PRIOR,
            own,
            {"depth": depth, "world_T_cam": poses, "log_scale": np.zeros(len(flat))},
            sigma=0.02,
            kernel=kernel,
        ),
        FactorBatch.create(
            ACCELERATION_SMOOTHNESS,
            tuple(slot(row[:, i : num_frames - 2 + i]) for i in range(3)),
            sigma=0.004,
            kernel=kernel,
        ),
        FactorBatch.create(
            ARAP,
            (slot(row[k, :-1]), slot(row[m, :-1]), slot(row[k, 1:]), slot(row[m, 1:])),
            sigma=0.01,
            kernel=kernel,
        ),
    )
    start = camera_to_world(poses, unproject(intrinsics, uv, depth))
    names = VariableNames(dynamic_track_frame=np.stack([10 * track, frame], axis=1))
    state = State({"dynamic_point": start}, names)
    return Problem(batches, all_free(state, "dynamic_point")), state


def slot(rows: np.ndarray) -> Slot:
    return Slot("dynamic_point", rows.reshape(-1))


def dense_jacobian(problem: Problem, state: State, groups: list[str]) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """Return the full J over every entry of the groups, r, and the first column of each group."""
    offset, size = {}, 0
    for group in groups:
        offset[group] = size
        size += len(state[group]) * TANGENT_DIM[group]
    blocks, residuals = [], []
    for batch in problem.batches:
        r, jacobians = batch.linearize(state)
        n, d = r.shape
        full = np.zeros((n, d, size))
        for s, jacobian in zip(batch.slots, jacobians, strict=True):
            if s.group not in offset:
                continue
            dim = TANGENT_DIM[s.group]
            for i in range(n):
                start = offset[s.group] + int(s.rows[i]) * dim
                full[i, :, start : start + dim] += jacobian[i]
        blocks.append(full.reshape(n * d, size))
        residuals.append(r.reshape(-1))
    return np.concatenate(blocks), np.concatenate(residuals), offset


def free_mask(problem: Problem, state: State, groups: list[str]) -> np.ndarray:
    """Return which of the columns of :func:`dense_jacobian` may move."""
    masks = []
    for group in groups:
        shape = (len(state[group]), TANGENT_DIM[group])
        masks.append(np.asarray(problem.free.get(group, np.zeros(shape, dtype=bool))).reshape(-1))
    return np.concatenate(masks)
