"""What of a static scene is trusted: residuals, outliers, and the noise that is left."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray, rows_by_group
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.factors.depth_prior import log_depth
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry.camera import NEAR_PLANE, project, seen_from
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.noise import intraclass_correlation
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import StaticNoise

_AT_ONCE = 1 << 20
"""Observations of which what is computed on the way is held at a time."""


def reprojection_residual(state: State, observations: Observations, row: IntArray) -> FloatArray:
    """Return the raw reprojection residual of every observation, (N, 2) px; ``row`` is its landmark's row."""
    return _off_by(state, observations, _in_cameras(state, observations, row))


def _in_cameras(state: State, observations: Observations, row: IntArray) -> FloatArray:
    """Return the landmark of every observation in the axes of its camera, (N, 3) m."""
    return seen_from(state[POSE], observations.frame, state[LANDMARK][row])


def _off_by(state: State, observations: Observations, x: FloatArray) -> FloatArray:
    """Return the raw reprojection residuals (N, 2), px, of points (N, 3) in the axes of their cameras."""
    residual: FloatArray = observations.uv - project(state[INTRINSICS][0], x)
    return residual


def landmark_errors(state: State, observations: Observations) -> Float32Array:
    """Return each landmark's median reprojection error, (N,) px."""
    tracks, row = observations.rows()
    norm = np.empty(len(row), np.float32)
    for first in range(0, len(row), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        residual = reprojection_residual(state, observations.select(some), row[some])
        norm[some] = np.linalg.norm(residual, axis=1)
    # Bits of positive floats are in the order of the floats: one sort by row, then by norm.
    bits = norm.view(np.uint32)
    order = np.sort(row.astype(np.uint64) << np.uint64(32) | bits)
    start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(tracks)))])
    middle = (start[:-1] + start[1:] - 1) // 2
    median: Float32Array = (order[middle] & np.uint64(0xFFFFFFFF)).astype(np.uint32).view(np.float32)
    return median


def drop_outliers(
    state: State, observations: Observations, config: BundleAdjustmentConfig, dropped: dict[str, int]
) -> tuple[State, Observations]:
    """Drop observations behind the camera, too far off, or of landmarks whose depth contradicts the cue."""
    tracks, row = observations.rows()
    x = _in_cameras(state, observations, row)
    z, residual = x[:, 2], _off_by(state, observations, x)
    behind = z <= NEAR_PLANE
    far = ~behind & (np.linalg.norm(residual, axis=1) > config.max_reprojection_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.abs(np.log(np.maximum(z, NEAR_PLANE) / observations.depth) - state[LOG_SCALE][observations.frame, 0])
    known = np.isfinite(ratio)
    wrong = np.bincount(row[known], ratio[known] > np.log(config.max_depth_ratio), len(tracks))
    contradicted = (wrong > 0.5 * np.bincount(row[known], minlength=len(tracks))) & (wrong > 0)
    astray = _astray(residual, observations, row, len(state[POSE]), config) & ~contradicted
    keep = ~(behind | far | (contradicted | astray)[row])
    kept = observations.select(keep).with_min_observations(min(config.min_observations, len(state[POSE])))
    stays = np.isin(tracks, kept.track)
    for reason, count in (
        ("observation behind the camera", int(behind.sum())),
        ("observation with a large reprojection error", int(far.sum())),
        ("landmark whose depth contradicts the cue", int(contradicted.sum())),
        ("landmark that departs from the others", int(astray.sum())),
        ("landmark left with too few observations", int((~stays & ~contradicted & ~astray).sum())),
    ):
        dropped[reason] = dropped.get(reason, 0) + count
    arrays = {**state.arrays, LANDMARK: state[LANDMARK][stays]}
    return State(arrays, {**state.index, LANDMARK: tracks[stays]}), kept


def _astray(
    residual: FloatArray, observations: Observations, row: IntArray, num_frames: int, config: BundleAdjustmentConfig
) -> BoolArray:
    """Return the landmarks (M,) of which most observations, off by ``residual`` (N, 2) px, are beyond the noise.

    The noise is that of all, or of a frame that has more: what is blurred is not to lose its camera.
    """
    count = np.bincount(row)
    if config.trim_sigmas is None:
        return np.zeros(len(count), np.bool_)
    everywhere = max(robust_sigma(residual), config.min_reprojection_sigma_px)
    frames = rows_by_group(observations.frame, num_frames)
    noise = np.fmax([robust_sigma(residual[rows]) for rows in frames], everywhere)
    beyond = np.linalg.norm(residual, axis=1) > config.trim_sigmas * noise[observations.frame]
    return np.asarray(np.bincount(row, beyond) > 0.5 * count)


def measure_noise(
    state: State, observations: Observations, noise: StaticNoise, config: BundleAdjustmentConfig
) -> StaticNoise:
    """Measure the noise of the static scene from what is left."""
    _, row = observations.rows()
    x = _in_cameras(state, observations, row)
    known = np.isfinite(observations.depth)
    depth = log_depth(x[known, 2]) - np.log(observations.depth[known])
    depth -= state[LOG_SCALE][observations.frame[known], 0]
    pixel, relative = robust_sigma(_off_by(state, observations, x)), robust_sigma(depth)
    wanted = pixel * config.reprojection_sigma_factor
    sigma = max(wanted, config.min_reprojection_sigma_px)
    return StaticNoise(
        sigma,
        max(relative, config.min_depth_sigma) if np.isfinite(relative) else noise.depth_sigma,
        intraclass_correlation(depth, row[known]) if np.isfinite(relative) else noise.depth_correlation,
        sigma / max(wanted, 1e-6 * sigma),
    )


def spatial_inliers(landmarks: FloatArray, config: BundleAdjustmentConfig) -> BoolArray:
    """Return which landmarks are not isolated: mean squared distance to 5 neighbors below the quantile rule."""
    if len(landmarks) < 7:
        return np.ones(len(landmarks), dtype=bool)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(landmarks).query(landmarks, k=6)
    score = np.mean(distance[:, 1:] ** 2, axis=1)
    result: BoolArray = score <= config.outlier_factor * np.quantile(score, config.outlier_quantile)
    return result
