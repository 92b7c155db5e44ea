r"""Relative depth made absolute (up to the one scale of the points): a scale and a shift per frame.

A network for relative depth gives ``d_t``, with inverse depth an unknown affine function of it:

    1 / z(x) = a_t d_t(x) + b_t.

Points of known depth ``z_{k,t}`` determine both, robustly, all frames at once:

    sum_{k,t} rho( (a_t d_{k,t} + b_t - 1/z_{k,t}) / (sigma m_t) )
      + sum_t sum_q ( ((a_{t+1} - a_t) q + (b_{t+1} - b_t)) / (tau m_t) )^2 / 6

m_t is the frame's median 1/z, sigma the measured noise, rho a robust kernel (Cauchy's, started
from Huber's); q runs over some quantiles of the
network's values at the points, so that tau says how much the aligned inverse depth may change from frame to frame
through a and b alone, whatever the network's own unit and origin. A frame with many points hardly feels it; one
with few follows its neighbors.

Nothing keeps ``a d + b`` positive where the network is far: depth is cut at ``max_depth_ratio`` times the
median of the frame. Iteratively reweighted least squares; the normal equations are block tridiagonal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg import LinAlgError, solveh_banded

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.config.geometric_depth import AffineDepthConfig
from uni4d_fg.cues.structure.triangulation import median_per_row
from uni4d_fg.errors import Cancelled, DegenerateProblemError, InputError
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.frontend.sequence.frames import LazyFrames
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.sequence.problems import some_of
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.robust import robust_sigma

_CONVERGED = 1e-5
"""A change below this part of the solution ends the reweighted solves."""
_FLAT = 1e-9
_FLAT_MAPS = (
    "relative depth: the network's maps are the same everywhere, so that they say nothing of depth. Check the output "
    "and the input scaling in its model card, and that the images are not empty"
)
_RIDGE = 1e-12
"""Relative addition to the diagonal, against rounding."""


@dataclass(frozen=True)
class AlignedDepths(LazyFrames[Float32Array]):
    """T depth maps (H, W): the network's, scaled and shifted when they are asked for."""

    network: FrameSource[Float32Array]
    scale: FloatArray
    shift: FloatArray
    floor: FloatArray
    """(T,) smallest inverse depth."""

    def __len__(self) -> int:
        return len(self.scale)

    def where(self, frame: int) -> str:
        """Return the frame number."""
        return f"aligned depth [frame {frame}]"

    def _read(self, frame: int) -> Float32Array:
        inverse = self.scale[frame] * self.network[frame].astype(np.float64) + self.shift[frame]
        known = np.isfinite(inverse)
        out = np.full(inverse.shape, np.nan, dtype=np.float32)
        out[known] = 1.0 / np.maximum(inverse[known], self.floor[frame])
        return out


@dataclass(frozen=True)
class AffineAlignment:
    """Scale and shift of every frame, and the depth that follows."""

    depths: AlignedDepths
    """T maps (H, W), in the unit of the points; NaN where the network has none."""
    scale: FloatArray
    """(T,) a_t."""
    shift: FloatArray
    """(T,) b_t, in one over the unit of the points."""
    sigma: float
    """Noise of the aligned inverse depth, as a part of the frame's median."""
    points: IntArray
    """(T,) number of points that had a say in each frame."""
    warnings: tuple[str, ...]


def align_affine(
    inverse_depth: FrameSource[Float32Array],
    tracks: Tracks,
    sparse_depth: Float32Array,
    config: AffineDepthConfig,
    *,
    free_shift: bool = True,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> AffineAlignment:
    """Fit a scale and a shift per frame to points of known depth.

    Args:
        inverse_depth: T maps (H, W) that grow with nearness; NaN where unknown. Each is read once.
        tracks: K tracks.
        sparse_depth: (K, T) depth of the tracks' observations; NaN where unknown.
        config: Kernel and smoothness.
        free_shift: False for inverse depth up to scale alone (one over depth up to scale): all shifts are 0.
        reporter: Progress.
        should_stop: Polled before every frame.

    Raises:
        InputError: If the lengths differ.
        DegenerateProblemError: If no frame has enough points, or the network's values fall with nearness.
        Cancelled: If ``should_stop`` turned true.
    """
    count = tracks.num_frames
    if len(inverse_depth) != count or sparse_depth.shape != tracks.visible.shape:
        raise InputError(
            f"relative depth: {len(inverse_depth)} maps and points {sparse_depth.shape} do not fit tracks "
            f"{tracks.visible.shape}; give one map per frame and one depth per observation"
        )
    samples = _sample(inverse_depth, tracks, sparse_depth, reporter or SilentReporter(), should_stop)
    enough = np.bincount(samples.frame, minlength=count) >= config.min_points
    refused = np.zeros(count, dtype=bool)
    while True:
        use = enough & ~refused
        if not use.any():
            raise DegenerateProblemError(_why(enough, config))
        chosen = samples.select(use[samples.frame])
        if free_shift and np.ptp(chosen.value) <= _FLAT * float(np.abs(chosen.value).max()):
            raise DegenerateProblemError(_FLAT_MAPS)
        try:
            fit = _fit(chosen, count, config, free_shift)
        except LinAlgError as error:
            raise DegenerateProblemError(_FLAT_MAPS) from error
        wrong = use & (fit.scale <= 0)
        if not wrong.any():
            break
        refused |= wrong
    typical = _typical(samples, use)
    floor = typical / config.max_depth_ratio
    points = np.where(use, np.bincount(samples.frame, minlength=count), 0)
    warnings = []
    if not use.all():
        warnings.append(
            f"relative depth of {int((~use).sum())} frame(s) has too few points (or contradicts them) and takes scale "
            f"and shift from its neighbors: {some_of(np.flatnonzero(~use).tolist())}"
        )
    depths = AlignedDepths(inverse_depth, fit.scale, fit.shift, floor)
    return AffineAlignment(depths, fit.scale, fit.shift, fit.sigma, points, tuple(warnings))


@dataclass(frozen=True)
class _Samples:
    """N points of known depth with the network's value there."""

    frame: IntArray
    value: FloatArray
    target: FloatArray
    """(N,) 1/z."""

    def select(self, keep: BoolArray) -> _Samples:
        return _Samples(self.frame[keep], self.value[keep], self.target[keep])


@dataclass(frozen=True)
class _Fit:
    scale: FloatArray
    shift: FloatArray
    sigma: float


def _sample(
    inverse_depth: FrameSource[Float32Array],
    tracks: Tracks,
    sparse_depth: Float32Array,
    reporter: Reporter,
    should_stop: Callable[[], bool] | None,
) -> _Samples:
    """Read the network's maps at all points, bilinearly."""
    frames, values, targets = [], [], []
    reporter.begin("scale and shift of relative depth", tracks.num_frames)
    with np.errstate(invalid="ignore"):
        known = tracks.visible & (sparse_depth > 0) & np.isfinite(sparse_depth)
    for frame in range(tracks.num_frames):
        if should_stop is not None and should_stop():
            raise Cancelled("aligning relative depth stopped")
        mine = np.flatnonzero(known[:, frame])
        if len(mine):
            uv = tracks.uv[mine, frame].astype(np.float32)
            image = np.ascontiguousarray(inverse_depth[frame], dtype=np.float32)
            value = cv2.remap(image, uv[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
            good = np.isfinite(value)
            frames.append(np.full(int(good.sum()), frame, dtype=np.int64))
            values.append(value[good].astype(np.float64))
            targets.append(1.0 / sparse_depth[mine[good], frame].astype(np.float64))
        reporter.advance(frame + 1)
    reporter.end()
    if not frames:
        return _Samples(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))
    return _Samples(np.concatenate(frames), np.concatenate(values), np.concatenate(targets))


def _typical(samples: _Samples, use: BoolArray) -> FloatArray:
    """Return the median 1/z of every frame, (T,); of a frame that is not used, that of the nearest one that is."""
    used = np.flatnonzero(use)
    medians = np.array([np.median(samples.target[samples.frame == frame]) for frame in used])
    nearest = np.argmin(np.abs(np.arange(len(use))[:, None] - used), axis=1)
    result: FloatArray = medians[nearest]
    return result


def _fit(samples: _Samples, count: int, config: AffineDepthConfig, free_shift: bool) -> _Fit:
    """Solve for scale and shift of all frames. Every frame in ``samples`` has points; others follow."""
    use = np.bincount(samples.frame, minlength=count) > 0
    typical = _typical(samples, use)
    # The network's unit and origin are arbitrary: solve in one where its values have median 0 and spread 1.
    origin = float(np.median(samples.value)) if free_shift else 0.0
    unit = max(robust_sigma(samples.value - origin), 1e-12)
    value = (samples.value - origin) / unit
    target = samples.target / typical[samples.frame]
    probes = np.quantile(value, config.probe_quantiles)
    link = _link(typical, probes, config.temporal_sigma)
    weight = np.ones(len(value))
    solution = np.zeros((count, 2))
    sigma = 1.0
    # Huber's energy has one minimum, which leads to that of Cauchy's: there far outliers count for nothing.
    for kernel in (Kernel("huber", config.kernel_threshold), Kernel("cauchy", config.kernel_threshold)):
        for iteration in range(config.max_iterations):
            previous = solution
            solution = _solve(samples.frame, value, target, weight, typical, sigma, link, free_shift)
            scale = solution[samples.frame, 0] / typical[samples.frame]
            shift = solution[samples.frame, 1] / typical[samples.frame]
            residual = scale * value + shift - target
            # About the frame's median: what is off as a whole is not noise, but a fit that outliers still hold.
            middle = median_per_row(residual, samples.frame, count)[samples.frame]
            sigma = max(robust_sigma(residual - middle), config.min_sigma)
            weight = kernel.weight((residual / sigma) ** 2)
            # The first solve still has the weights of the kernel before.
            if iteration and np.abs(solution - previous).max() <= _CONVERGED * np.abs(solution).max():
                break
    slope = solution[:, 0] / unit
    return _Fit(slope, solution[:, 1] - slope * origin if free_shift else np.zeros(count), sigma)


def _link(typical: FloatArray, probes: FloatArray, temporal_sigma: float) -> FloatArray:
    """Return the (T - 1, 2, 2) information that ties the scale and shift of one frame to those of the next."""
    rows = np.stack([probes, np.ones(len(probes))], axis=1)
    mean = 0.5 * (typical[:-1] + typical[1:])
    result: FloatArray = (rows.T @ rows)[None] / (len(probes) * (temporal_sigma * mean) ** 2)[:, None, None]
    return result


def _solve(
    frame: IntArray, value: FloatArray, target: FloatArray, weight: FloatArray, typical: FloatArray, sigma: float,
    link: FloatArray, free_shift: bool,
) -> FloatArray:  # fmt: skip
    """Solve the weighted normal equations; return (T, 2) scale and shift."""
    count = len(typical)
    information = weight / (sigma * typical[frame]) ** 2
    wanted = target * typical[frame]
    diagonal = np.zeros((count, 2, 2))
    right = np.zeros((count, 2))
    diagonal[:, 0, 0] = np.bincount(frame, information * value**2, count)
    diagonal[:, 0, 1] = diagonal[:, 1, 0] = np.bincount(frame, information * value, count)
    diagonal[:, 1, 1] = np.bincount(frame, information, count)
    right[:, 0] = np.bincount(frame, information * value * wanted, count)
    right[:, 1] = np.bincount(frame, information * wanted, count)
    diagonal[:-1] += link
    diagonal[1:] += link
    if not free_shift:
        out = np.zeros((count, 2))
        band = np.zeros((2, count))
        band[1] = diagonal[:, 0, 0] * (1.0 + _RIDGE)
        band[0, 1:] = -link[:, 0, 0]
        out[:, 0] = solveh_banded(band, right[:, 0])
        return out
    # Upper band of the 2T x 2T matrix: entry (i, j) is kept at [3 + i - j, j].
    band = np.zeros((4, 2 * count))
    band[3, 0::2], band[3, 1::2] = diagonal[:, 0, 0], diagonal[:, 1, 1]
    band[3] *= 1.0 + _RIDGE
    band[2, 1::2] = diagonal[:, 0, 1]
    band[2, 2::2] = -link[:, 1, 0]
    band[1, 2::2], band[1, 3::2] = -link[:, 0, 0], -link[:, 1, 1]
    band[0, 3::2] = -link[:, 0, 1]
    solution: FloatArray = solveh_banded(band, right.reshape(-1)).reshape(count, 2)
    return solution


def _why(enough: BoolArray, config: AffineDepthConfig) -> str:
    if not enough.any():
        return (
            f"relative depth: no frame has {config.min_points} points of known depth to be scaled by. Check masks and "
            "tracks, or use a network for metric depth"
        )
    return (
        "relative depth: the network's values fall where the scene comes nearer, in every frame. Check the output kind "
        "in its model card: this needs disparity or inverse depth, not depth"
    )
