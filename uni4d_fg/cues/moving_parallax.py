"""How near a moving thing is, from how the camera's shake moves it in the image.

A point ``X(t)`` that a camera at ``c(t)`` sees at depth ``z`` lies on the ray ``r(t) = (X(t) - c(t)) / z``, in world
axes and of depth one. One camera cannot tell the thing's motion from its own, except by how they change: a hand's
tremor has frequencies that things do not have. With ``u = 1 / z`` the rays' path is

    r(t) = -u c(t) + u X(t),

where ``u X(t)`` is smooth: its third differences are white noise, and what is measured has white noise besides. The
ratio of the two is found by restricted maximum likelihood (as for smoothing splines), and ``u`` is a generalized least
squares regression of the rays on the camera's path. A camera that moves as smoothly as the thing leaves ``u`` open,
which its standard deviation says.

Errors of the image do not bias it, errors of the cameras do. A camera that is wrong in position is wrong in rotation,
too, such that the static scene, at ``u_s``, is where it was seen: all things then seem to be there. If ``lambda`` is
the part of the path's differences that are such errors,

    u' = u_s + (u - u_s) (1 - lambda)

is found. ``lambda`` is known from how exactly cameras are known, but for a factor (errors of 17 rendered clips are 0.8
to 2.1 times as large as told, and 3.6 times where motion blurs the picture): where it may be near one, nothing is.

If the thing's depth changes, ``z(t) = z / s(t)`` by its apparent size ``s``, it holds for ``r(t) / s(t)``.

Sources: regression with errors in the regressor, Fuller, "Measurement Error Models" (1987); with a smooth nuisance,
Wahba, "Spline Models for Observational Data" (1990), chapter 9; when a trajectory can be reconstructed from one camera,
Park et al., "3D reconstruction of a moving point from a series of 2D projections" (ECCV 2010).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.cues.camera_noise import CameraNoise

_ORDER = 3
"""The thing's path has white differences of this order."""
_RATIOS = 10.0 ** np.arange(-6.0, 6.5, 0.5)
"""Variances of these differences, of that of the noise, that are tried."""
_MIN_TRACKS = 8
"""Tracks that two frames have to share."""
_MIN_FRAMES = 12
_MAX_FRAMES = 240
"""Longer videos are taken in parts, as work grows with the third power."""
_MIN_DISTANCE_PX = 6.0
"""Tracks nearer to each other say nothing of the size."""
_PAIRS = 1600
_MIN_PAIRS = 20
_DRAWS = 3
"""Of so many tracks the one that is nearest to another is paired with it: where a mask holds two things, pairs are
within either of them."""
_UPRIGHT = 0.5
"""Distances along columns are those of tracks that are at most twice as far apart across."""
_SIZE_WINDOW = 5
"""Frames over which the logarithm of the size is averaged."""
_OUTLIER = 3.0
_TOLD_TOO_SMALL = 4.0
"""Variances of the cameras' errors may be larger than those that are told by this factor."""


@dataclass(frozen=True)
class Parallax:
    """What the motion of the camera tells of one thing over frames that follow each other."""

    first: int
    size: FloatArray
    """(n,) apparent size in the frames ``first`` to ``first + n - 1``, one in the geometric mean."""
    inverse_depth: float
    """Where the size is one, in the world's unit."""
    sigma: float
    """Its standard deviation; infinite if nothing is known."""


def moving_parallax(
    uv: FloatArray, visible: BoolArray, world_T_cam: FloatArray, intrinsics: FloatArray, noise: CameraNoise
) -> list[Parallax]:
    """Measure one thing in every stretch of frames in which enough of its tracks go on.

    Args:
        uv: (K, T, 2) px, tracks on the thing.
        visible: (K, T).
        world_T_cam: (T, 4, 4).
        intrinsics: (4,) px.
        noise: Errors of the cameras.
    """
    rays = np.concatenate([(uv - intrinsics[2:]) / intrinsics[:2], np.ones((*uv.shape[:2], 1))], axis=2)
    rays = np.einsum("tij,ktj->kti", world_T_cam[:, :3, :3], np.nan_to_num(rays))
    shared = np.count_nonzero(visible[:, 1:] & visible[:, :-1], axis=0) >= _MIN_TRACKS
    ends = np.flatnonzero(np.diff(np.concatenate(([False], shared, [False])).astype(np.int64)))
    found = []
    for first, last in zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True):
        frames = slice(first, last + 1)
        size = _apparent_size(uv[:, frames], visible[:, frames])
        of_frames = replace(noise, covariance=noise.covariance[frames])
        inverse, sigma = _over_parts(
            rays[:, frames] / size[:, None], visible[:, frames], world_T_cam[frames, :3, 3], of_frames
        )
        found.append(Parallax(first, size, inverse, sigma))
    return found


def _apparent_size(uv: FloatArray, visible: BoolArray) -> FloatArray:
    """Return how large a thing appears, (T,), from how the distances between its tracks change.

    Half of it is what distances along the image's columns say: what turns about its height is foreshortened across.
    """
    rng = np.random.default_rng(0)
    steps = np.zeros(uv.shape[1] - 1)
    for frame in range(len(steps)):
        both = np.flatnonzero(visible[:, frame] & visible[:, frame + 1])
        a, others = rng.choice(both, _PAIRS), rng.choice(both, (_DRAWS, _PAIRS))
        before, after = (np.abs(uv[others, t] - uv[a, t]) for t in (frame, frame + 1))
        upright = before[..., 1] > _UPRIGHT * before[..., 0]
        steps[frame] = 0.5 * (
            _growth(np.linalg.norm(before, axis=2), np.linalg.norm(after, axis=2))
            + _growth(np.where(upright, before[..., 1], 0.0), after[..., 1])
        )
    log_size = np.concatenate(([0.0], np.cumsum(steps)))
    half = min(_SIZE_WINDOW, len(log_size)) // 2
    # Windows are cut alike on both sides at the ends, where one-sided means would flatten a trend.
    smooth = np.array(
        [log_size[t - w : t + w + 1].mean() for t in range(len(log_size)) for w in (min(half, t, len(steps) - t),)]
    )
    return np.asarray(np.exp(smooth - smooth.mean()))


def _growth(before: FloatArray, after: FloatArray) -> float:
    """Return the median log ratio of the shortest of some distances (draws, N) that is long enough; 0 of too few."""
    far = np.where(before > _MIN_DISTANCE_PX, before, np.inf)
    nearest = far.argmin(axis=0), np.arange(far.shape[1])
    before, after = far[nearest], after[nearest]
    good = np.isfinite(before) & (after > 0)
    if np.count_nonzero(good) < _MIN_PAIRS:
        return 0.0
    return float(np.median(np.log(after[good] / before[good])))


def _over_parts(rays: FloatArray, visible: BoolArray, centers: FloatArray, noise: CameraNoise) -> tuple[float, float]:
    """Return inverse depth and its standard deviation, as a mean over parts of a long stretch of frames."""
    parts = -(-len(centers) // _MAX_FRAMES)
    edges = np.linspace(0, len(centers), parts + 1).astype(np.int64)
    information = pull = 0.0
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if last - first < _MIN_FRAMES:
            continue
        part = slice(first, last)
        path, across = _path(rays[:, part], visible[:, part])
        variance = np.einsum("id,tij,jd->td", across, noise.covariance[part], across)
        inverse, sigma = regress(path @ across, centers[part] @ across, variance, noise.inverse_depth)
        if np.isfinite(sigma):
            information, pull = information + sigma**-2, pull + inverse * sigma**-2
    return (pull / information, information**-0.5) if information > 0 else (0.0, float("inf"))


def _path(rays: FloatArray, visible: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the path (T, 3) of the mean ray, which tracks enter and leave, and two directions (3, 2) across it."""
    steps = np.zeros((rays.shape[1] - 1, 3))
    for frame in range(len(steps)):
        both = visible[:, frame] & visible[:, frame + 1]
        moved = rays[both, frame + 1] - rays[both, frame]
        off = np.linalg.norm(moved - np.median(moved, axis=0), axis=1)
        steps[frame] = moved[off <= _OUTLIER * np.median(off)].mean(axis=0)
    mean = rays[visible].mean(axis=0)
    across = np.linalg.svd(mean[None])[2][1:].T
    return np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0))), across


def regress(
    path: FloatArray, centers: FloatArray, variance: FloatArray, static_inverse_depth: float
) -> tuple[float, float]:
    """Return ``u`` of ``path = -u centers + smooth + noise``, and its standard deviation.

    Args:
        path: (T, D)
        centers: (T, D)
        variance: (T, D) of the centers' errors; what is not finite leaves ``u`` open.
        static_inverse_depth: ``u_s``.
    """
    if len(path) <= _ORDER + 1:
        return 0.0, float("inf")
    differences = np.diff(np.eye(len(path)), n=_ORDER, axis=0)
    noise, basis = np.linalg.eigh(differences @ differences.T)
    transform = basis.T @ differences
    y, x, of_cameras = transform @ path, -transform @ centers, transform**2 @ variance
    count = y.size - 1
    best, found, part = -np.inf, (0.0, float("inf")), 1.0
    for ratio in _RATIOS:
        weight = 1.0 / (noise + ratio)[:, None]
        information = float((weight * x**2).sum())
        if information <= 0:
            continue
        u = float((weight * x * y).sum()) / information
        squares = max(float((weight * (y - u * x) ** 2).sum()), np.finfo(float).tiny)
        likelihood = -count * np.log(squares) + path.shape[1] * float(np.log(weight).sum()) - np.log(information)
        if likelihood > best:
            best, found = likelihood, (u, float(np.sqrt(squares / count / information)))
            part = float((weight * of_cameras).sum()) / information
    most = _TOLD_TOO_SMALL * part
    if not most < 1.0:
        return 0.0, float("inf")
    beyond, sigma = found[0] - static_inverse_depth, found[1]
    systematic = (most - part) / (1.0 - most) * beyond
    return static_inverse_depth + beyond / (1.0 - part), float(np.hypot(sigma / (1.0 - most), systematic))
