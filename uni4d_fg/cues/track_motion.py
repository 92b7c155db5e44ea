r"""Which tracks move: each is compared with the static scene between pairs of its frames.

The residual ``r = z_j - u'(z_i)`` of an observation pair (see :mod:`uni4d_fg.cues.static_scene`) is weighed by

    S = sigma_px^2 I + S_image + (sigma_z du')(sigma_z du')^T,

so that an error of depth explains what it can explain: motion along the epipolar line, by as much as depth may
be wrong. What the image does not hold in place, ``S_image`` explains (:mod:`uni4d_fg.cues.track_certainty`).
Where a track has no depth, sigma_z is large and only the distance from the epipolar line is left.
What all tracks of a pair of frames share (an error of pose or focal length) is fitted robustly by a quadratic
and taken off first. These sigmas are those of a hand-held camera and an uncertain depth; where tracks agree better with
a static scene, as those of a camera on a tripod do, departures are taken in units of what three quarters of the tracks
do not exceed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray, evenly_spread
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.static_scene import predict_static, relative_pose
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.robust import MAD_TO_SIGMA
from uni4d_fg.slam.stages.scene import Cameras

_MEDIAN_OF_CHI2 = 1.386
"""With two degrees of freedom."""
_PAIRS_AT_ONCE = 32
"""Pairs of frames whose quadratics are fitted together: more are no faster, and take memory."""

_AT_REST = 0.75
"""Part of the tracks that is taken to be at rest: the departure that it does not exceed measures the noise ..."""
_NOISE = (0.3, 1.0)
"""... within these bounds, in standard deviations of the configuration. Where more of them move, it is too high."""


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
class QuadraticGrid:
    """The terms of the quadratic at every pixel of smaller images."""

    terms: Float32Array
    """(6, h w)."""
    size: tuple[int, int]
    """(h, w)."""
    scale: FloatArray
    """(2,) smaller pixels per pixel, x and y."""

    @classmethod
    def of(cls, size: tuple[int, int], scale: FloatArray, image_size: tuple[int, int]) -> QuadraticGrid:
        """Return the terms for images of (h, w) ``size`` that are ``scale`` (2,) times one of ``image_size``."""
        height, width = image_size
        columns = (np.arange(size[1]) + 0.5) / scale[0] - 0.5
        rows = (np.arange(size[0]) + 0.5) / scale[1] - 0.5
        u, v = np.meshgrid((columns - width / 2) / width, (rows - height / 2) / width)
        return cls(np.stack(_quadratic(u.ravel(), v.ravel())).astype(np.float32), size, scale)

    def displacement(self, error: SharedError) -> tuple[Float32Array, Float32Array]:
        """Return the displacement (h, w) in x and y, in smaller pixels."""
        x, y = (error.coefficients * self.scale).T.astype(np.float32) @ self.terms
        return x.reshape(self.size), y.reshape(self.size)


@dataclass(frozen=True)
class TrackMotion:
    """What the tracks say."""

    moving: BoolArray
    """(K,) departs from the static scene for sure."""
    static: BoolArray
    """(K,) agrees with the static scene for sure; a track may be neither."""
    departure: FloatArray
    """(K,) standard deviations, of the tracks' own noise where that is less; NaN where it was not tested."""
    shared: dict[tuple[int, int], SharedError] = field(default_factory=dict)
    """(source, target) frame to what their tracks have in common."""


def find_moving_tracks(
    labelled: LabelledTracks,
    spread: Float32Array,
    cameras: Cameras,
    image_size: tuple[int, int],
    config: MotionMaskConfig,
    known_moving: BoolArray,
    with_shared: bool = True,
    position_variance: Float32Array | None = None,
) -> TrackMotion:
    """Test every track against the static scene.

    Args:
        labelled: K tracks with depth; labels and weights are not read.
        spread: (K, T) range of log depth around each observation.
        cameras: Poses of the T frames.
        image_size: (height, width), px.
        config: Baselines, sigmas and thresholds.
        known_moving: (K,) tracks to which what all share is not fitted, as a large thing would bend it.
        with_shared: Also return what the tracks share of pairs of frames that are compared but not tested.
        position_variance: (K, 3) px^2, covariances x x, x y and y y of positions, for what the image does not show of
            them; None for none.
    """
    num_tracks, num_frames = labelled.tracks.visible.shape
    departures: list[npt.NDArray[np.float32]] = []
    owners: list[npt.NDArray[np.int64]] = []
    shared: dict[tuple[int, int], SharedError] = {}
    steps = {*config.track_baselines, *(config.baselines if with_shared else ())}
    pairs = [
        (i, i + sign * step)
        for step in sorted(steps)
        for i in range(num_frames)
        for sign in (-1, 1)
        if 0 <= i + sign * step < num_frames
    ]
    scene = _TracksByFrame.of(labelled, spread, cameras, known_moving, position_variance)
    for first in range(0, len(pairs), _PAIRS_AT_ONCE):
        some = pairs[first : first + _PAIRS_AT_ONCE]
        seen = [scene.common(*pair, config, tested=abs(pair[1] - pair[0]) in config.track_baselines) for pair in some]
        for pair, motion, error in zip(some, seen, _fit_shared(seen, image_size, config), strict=True):
            if error is not None:
                shared[pair] = error
            if abs(pair[1] - pair[0]) in config.track_baselines:
                owners.append(motion.track)
                departures.append(motion.squared_departure(error).astype(np.float32))
    moving, static = np.zeros(num_tracks, bool), np.zeros(num_tracks, bool)
    result = np.full(num_tracks, np.nan)
    owner = np.concatenate(owners) if owners else np.zeros(0, np.int64)
    if len(owner):
        squared = _sorted_by_owner(np.concatenate(departures), owner)
        count = np.bincount(owner, minlength=num_tracks)
        start = np.concatenate(([0], np.cumsum(count)[:-1]))
        tested = count > 0
        pick = start + np.minimum((config.track_quantile * count).astype(np.int64), np.maximum(count - 1, 0))
        result[tested] = np.sqrt(squared[pick[tested]])
        result /= np.clip(np.quantile(result[tested], _AT_REST), *_NOISE)
        moving = tested & (result > config.moving_sigmas)
        static = tested & (result < config.static_sigmas)
    return TrackMotion(moving, static, result, shared)


@dataclass(frozen=True)
class _CommonMotion:
    """How n tracks move between two frames, other than a static scene would."""

    track: IntArray
    """(n,)."""
    uv: FloatArray
    """(n, 2) px in the first frame."""
    residual: FloatArray
    """(n, 2) px."""
    variance: tuple[FloatArray, FloatArray, FloatArray]
    """(n,) each, of x x, x y and y y, px^2."""
    thin: IntArray
    """Those (m,) to which what all share is fitted: some that may be at rest."""

    def squared_departure(self, error: SharedError | None) -> FloatArray:
        """Return the squared departures (n,) in standard deviations, without what the tracks share."""
        residual = self.residual
        if error is not None:
            residual = residual - np.stack(error.at(self.uv[:, 0], self.uv[:, 1]), axis=1)
        squared = mahalanobis(residual[:, 0], residual[:, 1], *self.variance)
        # Tracks of a blurred or fast pair of frames are all worse: what most of them do is noise, not motion.
        at_rest = squared[self.thin]
        return squared / max(1.0, float(np.median(at_rest)) / _MEDIAN_OF_CHI2) if len(at_rest) else squared


@dataclass(frozen=True)
class _TracksByFrame:
    """K tracks in T frames, each frame's together in memory."""

    visible: BoolArray
    """(T, K)."""
    uv: Float32Array
    """(T, K, 2) px."""
    depth: Float32Array
    """(T, K) NaN where missing."""
    spread: Float32Array
    """(T, K) range of log depth around."""
    cameras: Cameras
    may_rest: BoolArray
    """(K,) False for those that are known to move."""
    position_variance: Float32Array
    """(K, 3) px^2."""

    @classmethod
    def of(
        cls, labelled: LabelledTracks, spread: Float32Array, cameras: Cameras, known_moving: BoolArray,
        position_variance: Float32Array | None,
    ) -> _TracksByFrame:  # fmt: skip
        """Return tracks by frame."""
        return cls(
            np.ascontiguousarray(labelled.tracks.visible.T),
            np.ascontiguousarray(labelled.tracks.uv.transpose(1, 0, 2)),
            np.ascontiguousarray(labelled.depth.T),
            np.ascontiguousarray(spread.T),
            cameras,
            ~known_moving,
            np.zeros((len(known_moving), 3), np.float32) if position_variance is None else position_variance,
        )

    def common(self, source: int, target: int, config: MotionMaskConfig, tested: bool) -> _CommonMotion:
        """Return the motion of the tracks that two frames both see, none where no depth is known.

        Args:
            source: Frame whose depth is taken.
            target: Frame in which its points are looked at.
            config: Sigmas.
            tested: Of all tracks, and not only of those to which what they share is fitted.
        """
        seen = np.flatnonzero(self.visible[source] & self.visible[target])
        depth = self.depth[source, seen].astype(np.float64)
        known = np.isfinite(depth)
        if not known.any():
            nothing = np.zeros(0)
            return _CommonMotion(seen[:0], np.zeros((0, 2)), np.zeros((0, 2)), (nothing,) * 3, seen[:0])
        usual = np.median(depth[known]) if not known.all() else 1.0
        rest = np.flatnonzero(self.may_rest[seen])
        thin = rest[evenly_spread(len(rest), config.shared_max_tracks)]
        if not tested:
            seen, depth, known, thin = seen[thin], depth[thin], known[thin], np.arange(len(thin))
        uv, uv_target = (self.uv[frame, seen].astype(np.float64) for frame in (source, target))
        log_depth = np.log(np.where(known, depth, usual)) + self.cameras.log_scale[source]
        pose = relative_pose(self.cameras.world_T_cam, source, target)
        static = predict_static(uv[:, 0], uv[:, 1], log_depth, pose, self.cameras.intrinsics)
        residual = uv_target - np.stack((static.u, static.v), axis=1)
        sigma_depth = np.where(known, config.depth_sigma + 0.5 * self.spread[source, seen], config.depthless_sigma)
        du, dv = static.du * sigma_depth, static.dv * sigma_depth
        own, (xx, xy, yy) = config.track_sigma_px**2, self.position_variance[seen].astype(np.float64).T
        variance = (own + xx + du * du, xy + du * dv, own + yy + dv * dv)
        return _CommonMotion(seen, uv, residual, variance, thin)


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
    motions: list[_CommonMotion], size: tuple[int, int], config: MotionMaskConfig
) -> list[SharedError | None]:
    """Fit a quadratic to the residuals of each pair of frames by reweighted least squares; None with too few tracks."""
    height, width = size
    fitted = [n for n, motion in enumerate(motions) if len(motion.thin) >= config.shared_min_tracks]
    count = np.array([len(motions[n].thin) for n in fitted], dtype=np.int64)
    if not fitted:
        return [None] * len(motions)
    # All pairs at once; what a pair has fewer of is padded with what weighs nothing.
    shape = (len(fitted), int(count.max()))
    terms, chosen, inverse = np.zeros((*shape, 6)), np.zeros((*shape, 2)), np.zeros(shape)
    for row, n in enumerate(fitted):
        motion, thin = motions[n], motions[n].thin
        x, y = (motion.uv[thin] - np.array([width / 2, height / 2])).T / width
        terms[row, : len(thin)] = np.stack(_quadratic(x, y), axis=1)
        chosen[row, : len(thin)] = motion.residual[thin]
        inverse[row, : len(thin)] = 1.0 / np.sqrt(np.maximum(motion.variance[0], motion.variance[2])[thin])
    absent = np.arange(shape[1]) >= count[:, None]
    weight = inverse**2
    coefficients: FloatArray = np.zeros((len(fitted), 6, 2))
    for _ in range(8):
        weighted = (terms * weight[..., None]).swapaxes(1, 2)
        normal = weighted @ terms + config.shared_prior * weight.sum(axis=1)[:, None, None] * np.eye(6)
        coefficients = np.asarray(np.linalg.solve(normal, weighted @ chosen), np.float64)
        off = chosen - terms @ coefficients
        miss = np.hypot(off[..., 0], off[..., 1]) * inverse
        scale = np.maximum(1.5 * MAD_TO_SIGMA * _medians(np.where(absent, np.inf, miss), count), 1e-6)
        weight = inverse**2 / (1.0 + (miss / scale[:, None]) ** 2) ** 2
    found: list[SharedError | None] = [None] * len(motions)
    for row, n in enumerate(fitted):
        found[n] = SharedError(coefficients[row], size)
    return found


def _sorted_by_owner(values: Float32Array, owner: IntArray) -> Float32Array:
    """Return values (n,), none of them negative, by owner (n,) and then ascending.

    Sorted as whole numbers, the owner in front of the bits of the value: in a fifth of the time of a sort by two keys.
    """
    keys = owner.astype(np.uint64) << np.uint64(32) | values.view(np.uint32)
    keys.sort()
    return keys.astype(np.uint32).view(np.float32)


def _medians(values: FloatArray, count: IntArray) -> FloatArray:
    """Return the medians (n,) of the least ``count`` (n,) of each row of values (n, m)."""
    ordered = np.sort(values, axis=1)
    row = np.arange(len(values))
    return np.asarray(0.5 * (ordered[row, (count - 1) // 2] + ordered[row, count // 2]))
