"""Whether two small images show the same scene: corners that are found again, or an overlap that looks the same."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from uni4d_fg.config.shots import ShotsConfig

_LOCAL_PX = 8.0
"""Sigma of the neighborhood that brightness and contrast are taken relative to: exposure changes leave no trace."""
_NOISE = 4.0
"""Gray values of contrast that count as nothing."""
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.05)
_WINDOW = (13, 13)
_LEVELS = 3
_BLURS = ((0.0, False), (0.1, False), (0.2, False), (0.1, True))
"""Lengths of blur, part of the longer side, and whether it is vertical."""
_COARSE_LOCAL_PX = 10.0
_BORDER = 3
_SCALES = (0.5, 2.0)
"""Of a similarity between two frames of one scene; beyond these the matches are wrong."""


@dataclass(frozen=True)
class SmallFrame:
    """One frame as the search for cuts sees it."""

    gray: ImageArray
    """(h, w) uint8."""
    local: ImageArray
    """(h, w) uint8, brightness and contrast relative to the neighborhood."""
    corners: Float32Array
    """(N, 2) px."""
    shows_something: bool

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), px."""
        return self.gray.shape[0], self.gray.shape[1]


@dataclass(frozen=True)
class Link:
    """What connects two frames."""

    found: float
    """Part of the corners that should be in the other image and were found there."""
    source_T_target: FloatArray
    """(2, 3) the similarity that takes pixels of the first to those of the second."""
    overlap: float
    """Part of the corners that should be in the other image."""


def small_gray(image: ImageArray, longer_side: int) -> ImageArray:
    """Return an (H, W, 3) or (H, W) uint8 image as gray values (h, w) whose longer side is at most as given, px."""
    gray = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    scale = min(1.0, longer_side / max(gray.shape))
    size = (max(16, round(gray.shape[1] * scale)), max(16, round(gray.shape[0] * scale)))
    if size == gray.shape[::-1]:
        return gray
    smaller: ImageArray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    return smaller


def small_frame(image: ImageArray, config: ShotsConfig) -> SmallFrame:
    """Make an (H, W, 3) or (H, W) uint8 image small, with its corners."""
    gray = small_gray(image, config.width)
    values = gray.astype(np.float32)
    local = np.clip(128.0 + 50.0 * _relative(values, _LOCAL_PX), 0, 255).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(local, config.max_corners, 0.02, 4)
    points = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
    visible = len(points) >= config.min_corners and float(values.std()) >= config.min_contrast
    return SmallFrame(gray, local, points, visible)


def link(source: SmallFrame, target: SmallFrame, guess: FloatArray, config: ShotsConfig) -> Link:
    """Look for the corners of one frame in another.

    Args:
        source: The one.
        target: The other.
        guess: (2, 3) similarity that takes pixels of the one to about where they are in the other.
        config: Checks.
    """
    points = source.corners
    start = (points @ guess[:, :2].T + guess[:, 2]).astype(np.float32)
    inside = _inside(start, target.size)
    overlap = float(inside.mean()) if len(points) else 0.0
    if inside.sum() < config.min_corners or not (source.shows_something and target.shows_something):
        return Link(0.0, guess, overlap)
    points, start = points[inside], start[inside]
    moved, status = flow(source.local, target.local, points, start)
    back, status_back = flow(target.local, source.local, moved, (points + (moved - start)).astype(np.float32))
    kept = status & status_back & _inside(moved, target.size)
    kept &= np.linalg.norm(back - points, axis=1) <= config.forward_backward_px
    kept[kept] = similarity(source.local, target.local, points[kept], moved[kept], config.patch_px) >= (
        config.min_similarity
    )
    found = float(kept.mean())
    motion = guess
    if kept.sum() >= config.min_corners:
        fitted, _ = cv2.estimateAffinePartial2D(
            points[kept], moved[kept], method=cv2.RANSAC, ransacReprojThreshold=2.0, maxIters=200
        )
        if fitted is not None and has_plausible_scale(fitted):
            motion = fitted
    return Link(found, motion, overlap)


def has_plausible_scale(similarity: np.ndarray) -> bool:
    """Tell whether a similarity (2, 3) between two frames scales by what the size of one scene may change by."""
    return bool(_SCALES[0] < np.hypot(similarity[0, 0], similarity[0, 1]) < _SCALES[1])


def pan_between(source: SmallFrame, target: SmallFrame, min_overlap: float) -> tuple[float, FloatArray]:
    """Find the shift at which two frames look the same, blurred by a fast pan or not.

    The correlation of what the frames share is taken for all shifts at once (Padfield, "Masked object registration in
    the Fourier domain", 2012). A frame of a pan is blurred along it, the one before it may not be: both are blurred
    alike, by several lengths.

    Args:
        source: The one.
        target: The other.
        min_overlap: Part of the image that is shared, at least.

    Returns:
        The correlation, and (2, 3) how pixels move.
    """
    best, shift = 0.0, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for part, vertical in _BLURS:
        length = max(1, round(part * max(source.size)))
        kernel = (1, length) if vertical else (length, 1)
        found, dx, dy = _best_shift(_coarse(source.gray, kernel), _coarse(target.gray, kernel), min_overlap)
        if found > best:
            best, shift = found, np.array([[1.0, 0.0, 2.0 * dx], [0.0, 1.0, 2.0 * dy]])
    return best, shift


def _coarse(gray: ImageArray, kernel: tuple[int, int]) -> FloatArray:
    """Return an image of half the size, blurred, relative to its neighborhood."""
    values = cv2.blur(gray.astype(np.float32), kernel)
    local = _relative(values, _COARSE_LOCAL_PX)
    coarse: FloatArray = cv2.resize(local, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).astype(np.float64)
    return coarse


def _best_shift(one: FloatArray, other: FloatArray, min_overlap: float) -> tuple[float, int, int]:
    """Return the highest correlation over all shifts, and the shift (x, y) in px."""
    height, width = one.shape
    size = (2 * height, 2 * width)

    def sums(left: FloatArray, right: FloatArray) -> FloatArray:
        return np.fft.irfft2(np.conj(np.fft.rfft2(left, size)) * np.fft.rfft2(right, size), size)

    ones = np.ones_like(one)
    count = np.maximum(sums(ones, ones), 1e-3)
    sum_one, sum_other = sums(one, ones), sums(ones, other)
    products = sums(one, other) - sum_one * sum_other / count
    spread = (sums(one * one, ones) - sum_one**2 / count) * (sums(ones, other * other) - sum_other**2 / count)
    correlation = products / np.sqrt(np.maximum(spread, 1e-3))
    correlation[count < min_overlap * height * width] = -1.0
    row, column = np.unravel_index(int(np.argmax(correlation)), size)
    dy = int(row) - size[0] if row > height else int(row)
    dx = int(column) - size[1] if column > width else int(column)
    return float(correlation[row, column]), dx, dy


def _relative(values: Float32Array, sigma: float) -> Float32Array:
    """Return gray values relative to the mean and contrast of their neighborhood."""
    mean = cv2.GaussianBlur(values, (0, 0), sigma)
    deviation = np.sqrt(np.maximum(cv2.GaussianBlur(values * values, (0, 0), sigma) - mean * mean, 0.0))
    relative: Float32Array = (values - mean) / (deviation + _NOISE)
    return relative


def similarity(
    source: ImageArray, target: ImageArray, points: Float32Array, moved: Float32Array, patch_px: int
) -> FloatArray:
    """Return (N,) the correlation of the patches around points of one image and those of another."""
    one, other = _patches(source, points, patch_px), _patches(target, moved, patch_px)
    one -= one.mean(axis=1, keepdims=True)
    other -= other.mean(axis=1, keepdims=True)
    scale = np.sqrt((one * one).sum(axis=1) * (other * other).sum(axis=1))
    result: FloatArray = (one * other).sum(axis=1) / np.maximum(scale, 1e-9)
    return result


def _patches(image: ImageArray, points: Float32Array, patch_px: int) -> FloatArray:
    """Return (N, patch_px * patch_px) gray values around points, the border repeated."""
    offsets = np.arange(patch_px, dtype=np.float32) - patch_px // 2
    x = points[:, 0, None, None] + offsets[None, None, :] + 0.0 * offsets[None, :, None]
    y = points[:, 1, None, None] + offsets[None, :, None] + 0.0 * offsets[None, None, :]
    count = len(points)
    if count == 0:
        return np.zeros((0, patch_px * patch_px))
    sampled = cv2.remap(
        image, x.reshape(count, -1).astype(np.float32), y.reshape(count, -1).astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    values: FloatArray = sampled.astype(np.float64)
    return values


def flow(
    source: ImageArray, target: ImageArray, points: Float32Array, start: Float32Array
) -> tuple[Float32Array, BoolArray]:
    """Return where points (N, 2) px of one image are in another, and whether (N,) they were found.

    The search begins at ``start`` (N, 2) px.
    """
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        source, target, np.ascontiguousarray(points), start.copy(), winSize=_WINDOW, maxLevel=_LEVELS,
        criteria=_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return moved.reshape(-1, 2), status.ravel() > 0


def _inside(points: Float32Array, size: tuple[int, int]) -> BoolArray:
    height, width = size
    low: BoolArray = np.asarray((points >= _BORDER).all(axis=1))
    high: BoolArray = np.asarray((points <= (width - 1 - _BORDER, height - 1 - _BORDER)).all(axis=1))
    return low & high
