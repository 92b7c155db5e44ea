r"""Which tracks move: each is compared with the static scene between pairs of its frames.

The residual ``r = z_j - u'(z_i)`` of an observation pair (see :mod:`uni4d_fg.cues.static_scene`) is weighed by

    S = sigma_px^2 I + (sigma_z du')(sigma_z du')^T,

so that an error of depth explains what it can explain: motion along the epipolar line, by as much as depth may
be wrong. Where a track has no depth, sigma_z is large and only the distance from the epipolar line is left.
What all tracks of a pair of frames share (an error of pose or focal length) is fitted robustly by a quadratic
and taken off first.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, evenly_spread
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.static_scene import predict_static, relative_pose
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.slam.stages.scene import Cameras

_MEDIAN_OF_CHI2 = 1.386
"""With two degrees of freedom."""


@dataclass(frozen=True)
class SharedError:
    """Displacement between two frames that an error of the cameras causes: a quadratic of the pixel."""

    coefficients: FloatArray
    """(6, 2) px."""
    size: tuple[int, int]
    """(height, width), px, of the image the coefficients refer to."""

    def at(self, u: npt.NDArray[np.floating], v: npt.NDArray[np.floating]) -> tuple[FloatArray, FloatArray]:
        """Return the displacement (x, y) at pixels of any shape, px."""
        height, width = self.size
        terms = _quadratic((u - width / 2) / width, (v - height / 2) / width)
        return (
            np.asarray(sum(c * term for c, term in zip(self.coefficients[:, 0], terms, strict=True))),
            np.asarray(sum(c * term for c, term in zip(self.coefficients[:, 1], terms, strict=True))),
        )


@dataclass(frozen=True)
class TrackMotion:
    """What the tracks say."""

    moving: BoolArray
    """(K,) departs from the static scene for sure."""
    static: BoolArray
    """(K,) agrees with the static scene for sure; a track may be neither."""
    departure: FloatArray
    """(K,) standard deviations, NaN where it was not tested."""
    shared: dict[tuple[int, int], SharedError] = field(default_factory=dict)
    """(source, target) frame to what their tracks have in common."""


def find_moving_tracks(
    labelled: LabelledTracks,
    spread: Float32Array,
    cameras: Cameras,
    image_size: tuple[int, int],
    config: MotionMaskConfig,
) -> TrackMotion:
    """Test every track against the static scene.

    Args:
        labelled: K tracks with depth; labels and weights are not read.
        spread: (K, T) range of log depth around each observation.
        cameras: Poses of the T frames.
        image_size: (height, width), px.
        config: Baselines, sigmas and thresholds.
    """
    num_tracks, num_frames = labelled.tracks.visible.shape
    departures: list[npt.NDArray[np.float32]] = []
    owners: list[npt.NDArray[np.int64]] = []
    shared: dict[tuple[int, int], SharedError] = {}
    frames = [
        (i, i + sign * step)
        for step in sorted({*config.track_baselines, *config.baselines})
        for i in range(num_frames)
        for sign in (-1, 1)
        if 0 <= i + sign * step < num_frames
    ]
    for source, target in frames:
        track, squared, error = _test_pair(labelled, spread, cameras, source, target, image_size, config)
        if error is not None:
            shared[source, target] = error
        if abs(target - source) in config.track_baselines:
            owners.append(track)
            departures.append(squared.astype(np.float32))
    moving, static = np.zeros(num_tracks, bool), np.zeros(num_tracks, bool)
    result = np.full(num_tracks, np.nan)
    owner = np.concatenate(owners) if owners else np.zeros(0, np.int64)
    if len(owner):
        squared = np.concatenate(departures)
        count = np.bincount(owner, minlength=num_tracks)
        order = np.lexsort((squared, owner))
        start = np.concatenate(([0], np.cumsum(count)[:-1]))
        tested = count > 0
        pick = start + np.minimum((config.track_quantile * count).astype(np.int64), np.maximum(count - 1, 0))
        result[tested] = np.sqrt(squared[order][pick[tested]])
        moving = tested & (result > config.moving_sigmas)
        static = tested & (result < config.static_sigmas)
    return TrackMotion(moving, static, result, shared)


def _test_pair(
    labelled: LabelledTracks,
    spread: Float32Array,
    cameras: Cameras,
    source: int,
    target: int,
    image_size: tuple[int, int],
    config: MotionMaskConfig,
) -> tuple[npt.NDArray[np.int64], FloatArray, SharedError | None]:
    """Return the tracks seen in both frames (n,), their squared departures (n,), and what they share."""
    tracks = labelled.tracks
    seen = np.flatnonzero(tracks.visible[:, source] & tracks.visible[:, target])
    uv, uv_target = (tracks.uv[seen, frame].astype(np.float64) for frame in (source, target))
    depth = labelled.depth[seen, source].astype(np.float64)
    known = np.isfinite(depth)
    if len(seen) == 0 or not known.any():
        return seen[:0], np.zeros(0), None
    log_depth = np.log(np.where(known, depth, np.median(depth[known]))) + cameras.log_scale[source]
    pose = relative_pose(cameras.world_T_cam, source, target)
    static = predict_static(uv[:, 0], uv[:, 1], log_depth, pose, cameras.intrinsics)
    residual = uv_target - np.stack((static.u, static.v), axis=1)
    sigma_depth = np.where(known, config.depth_sigma + 0.5 * spread[seen, source], config.depthless_sigma)
    du, dv = static.du * sigma_depth, static.dv * sigma_depth
    variance = (config.track_sigma_px**2 + du * du, du * dv, config.track_sigma_px**2 + dv * dv)
    error = _fit_shared(uv, residual, variance, image_size, config)
    if error is not None:
        residual -= np.stack(error.at(uv[:, 0], uv[:, 1]), axis=1)
    squared = mahalanobis(residual[:, 0], residual[:, 1], *variance)
    # Tracks of a blurred or fast pair of frames are all worse: what most of them do is noise, not motion.
    return seen, squared / max(1.0, float(np.median(squared)) / _MEDIAN_OF_CHI2), error


def mahalanobis(
    x: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    xx: npt.NDArray[np.floating],
    xy: npt.NDArray[np.floating],
    yy: npt.NDArray[np.floating],
) -> FloatArray:
    """Return ``r^T S^-1 r`` of vectors (x, y) with covariances ((xx, xy), (xy, yy)), any shape."""
    return np.asarray((yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy))


def _quadratic(x: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.floating], ...]:
    return np.ones_like(x), x, y, x * x, x * y, y * y


def _fit_shared(
    uv: FloatArray,
    residual: FloatArray,
    variance: tuple[FloatArray, FloatArray, FloatArray],
    size: tuple[int, int],
    config: MotionMaskConfig,
) -> SharedError | None:
    """Fit a quadratic to residuals (n, 2) by iteratively reweighted least squares; None with too few."""
    if len(uv) < config.shared_min_tracks:
        return None
    thin = evenly_spread(len(uv), config.shared_max_tracks)
    height, width = size
    terms = np.stack(
        _quadratic((uv[thin, 0] - width / 2) / width, (uv[thin, 1] - height / 2) / width), axis=1
    )  # fmt: skip
    chosen = residual[thin]
    inverse = 1.0 / np.sqrt(np.maximum(variance[0], variance[2])[thin])
    weight = inverse**2
    coefficients: FloatArray = np.zeros((6, 2))
    for _ in range(8):
        normal = (terms * weight[:, None]).T @ terms
        normal += config.shared_prior * weight.sum() * np.eye(6)
        coefficients = np.asarray(np.linalg.solve(normal, (terms * weight[:, None]).T @ chosen), np.float64)
        miss = np.linalg.norm(chosen - terms @ coefficients, axis=1) * inverse
        scale = max(1.5 * 1.4826 * float(np.median(miss)), 1e-6)
        weight = inverse**2 / (1.0 + (miss / scale) ** 2) ** 2
    return SharedError(coefficients, size)
