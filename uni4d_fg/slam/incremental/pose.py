"""The pose of a new frame: constant velocity, then its tracks against points that are known, robustly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import NEAR_PLANE, world_to_camera
from uni4d_fg.optim.cluster_robust import clustered_marginals
from uni4d_fg.optim.marginals import camera_marginals
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.slam.incremental.labels import LabelledFrame
from uni4d_fg.slam.incremental.point_errors import PointErrors
from uni4d_fg.slam.stages.energy import MAP
from uni4d_fg.slam.stages.lifting import frame_log_scales
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise
from uni4d_fg.slam.stages.static_covariance import track_cells
from uni4d_fg.slam.stages.static_outliers import reprojection_residual
from uni4d_fg.slam.stages.structure import depth_prior_terms, reprojection_term


@dataclass(frozen=True)
class FramePose:
    """A new frame's pose relative to the known points."""

    world_T_cam: FloatArray
    log_scale: float
    inlier: BoolArray
    """(n,) which of the observations agree with it."""
    covariance: FloatArray
    """(6, 6) given the points, with clusters of tracks that may err alike; NaN if not determined."""


def predict(poses: FloatArray, frames: FloatArray, frame: float) -> FloatArray:
    """Continue the last relative motion (constant velocity per frame).

    Args:
        poses: (n, 4, 4), the last one or two are used.
        frames: (n,) their frame numbers.
        frame: The number of the new one.
    """
    if len(poses) < 2:
        return np.asarray(poses[-1])
    step = se3.inverse(poses[-2]) @ poses[-1]
    gap = float(frames[-1] - frames[-2])
    omega = se3.so3_log(step[None, :3, :3])[0]
    factor = float(frame - frames[-1]) / gap
    moved = np.eye(4)
    moved[:3, :3] = se3.so3_exp(factor * omega)
    moved[:3, 3] = factor * step[:3, 3]
    result: FloatArray = se3.orthonormalize(poses[-1] @ moved)
    return result


def locate(
    guesses: list[FloatArray],
    tracks: LabelledFrame,
    points: FloatArray,
    intrinsics: FloatArray,
    noise: StaticNoise,
    config: Config,
    run: StageRunner,
    log_scale: float = 0.0,
    errors: PointErrors | None = None,
) -> FramePose:
    """Solve a frame's pose and log-scale with the points held, from each guess; the most inliers win.

    Args:
        guesses: (4, 4) starting poses; later ones are tried only if fewer than half agree.
        tracks: n observations.
        points: (n, 3) their world points.
        intrinsics: (4,).
        noise: Sigmas.
        config: Stage 2's kernels and outlier rule, and the pose solver.
        run: What solves the declared stage.
        log_scale: What the depth cues of all frames share; the prior on the frame's own is about it.
        errors: How uncertain the points are; exact when None.
    """
    zero = np.zeros(len(points), dtype=np.int64)
    observations = Observations(np.arange(len(points)), zero, tracks.uv, tracks.depth, tracks.weight)
    ba = config.bundle_adjustment
    sigma = noise.effective_depth_sigma(2.0) * ba.depth_sigma_factor
    batches = [
        reprojection_term(observations, observations.track, noise.reprojection_sigma_px, 1, ba, MAP),
        *depth_prior_terms(observations, observations.track, sigma, 1, ba, log_scale),
    ]
    free = {POSE: np.ones((1, 6), dtype=bool), LOG_SCALE: np.ones((1, 1), dtype=bool)}
    stage = Stage("pose", Problem(tuple(batches), free), config.incremental.pose_solver)
    best: tuple[State, BoolArray] | None = None
    for guess in guesses:
        scale = frame_log_scales(observations, guess[None], points, 1)
        state, _ = run(stage, Cameras(guess[None], intrinsics, scale).state(points), None)
        error = np.linalg.norm(reprojection_residual(state, observations, observations.track), axis=1)
        z = world_to_camera(np.broadcast_to(state[POSE][0], (len(points), 4, 4)), points)[:, 2]
        inlier: BoolArray = (error <= ba.max_reprojection_px) & (z > NEAR_PLANE)
        if best is None or inlier.sum() > best[1].sum():
            best = (state, inlier)
        if inlier.sum() > 0.5 * len(points):
            break
    assert best is not None
    state, inlier = best
    marginals = camera_marginals(stage.problem, state, stage.solver, None)
    if marginals is None:
        return FramePose(state[POSE][0], float(state[LOG_SCALE][0, 0]), inlier, np.full((6, 6), np.nan))
    model = covariance = marginals.blocks(POSE, 1)[0]
    clusters = track_cells(observations, intrinsics, ba)
    shared = None if clusters is None else clustered_marginals(stage.problem, state, stage.solver, clusters)
    if shared is not None:
        # The points are uncertain too, and cells are few: neither figure is trusted where it is the smaller one.
        covariance = larger_covariance(covariance, shared.blocks(POSE, 1)[0])
    if errors is not None:
        cells = observations.track if clusters is None else clusters.of_landmark
        covariance = covariance + errors.spread(stage.problem.batches[0], state, model, cells)
    return FramePose(state[POSE][0], float(state[LOG_SCALE][0, 0]), inlier, covariance)


def larger_covariance(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the smallest covariance (n, n) that, on the axes the two share, is at least as large as either."""
    root = np.linalg.cholesky(first)
    whitened = np.linalg.solve(root, np.linalg.solve(root, second).T)
    values, axes = np.linalg.eigh(0.5 * (whitened + whitened.T))
    factor = root @ (axes * np.sqrt(np.maximum(values, 1.0)))
    result: FloatArray = factor @ factor.T
    return result


def refocused(reference_T_cam: FloatArray, ratio: FloatArray, deeper: float) -> FloatArray:
    """Return a small relative pose (4, 4) as it would have been found with other focal lengths and depths.

    To first order in the motion, with points that the reference sees at known depths, pixels tell the step as a part of
    the points' distance: f_x times that along x, f_y times that along y, and the one along z whatever the focal lengths
    are. The turn is kept: how much of it follows depends on the field of view.

    Args:
        reference_T_cam: (4, 4).
        ratio: (2,) of the focal lengths (x, y) that it was found with to the others.
        deeper: Of the other depths to those that it was found with.
    """
    out = reference_T_cam.copy()
    out[:3, 3] *= deeper * np.array([ratio[0], ratio[1], 1.0])
    return out


def shared_spread(reference_T_cam: FloatArray, focal_sigma: float, depth_sigma: float) -> FloatArray:
    """Return the covariance (6, 6) that a small relative pose has of what all its points share, see :func:`refocused`.

    Turns about the image axes count with the focal length's whole error, which is the most that a narrow view gives.

    Args:
        reference_T_cam: (4, 4).
        focal_sigma: Standard deviation of the logarithm of both focal lengths.
        depth_sigma: Standard deviation of the logarithm of the points' scale.
    """
    omega = se3.so3_log(reference_T_cam[None, :3, :3])[0]
    focal = focal_sigma * np.concatenate([omega[:2], [0.0], reference_T_cam[:2, 3], [0.0]])
    depth = depth_sigma * np.concatenate([np.zeros(3), reference_T_cam[:3, 3]])
    return np.outer(focal, focal) + np.outer(depth, depth)
