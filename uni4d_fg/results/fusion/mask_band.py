"""Which pixels beside masks look like the moving thing, as masks may be too small, and which inside stand still."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array, IntArray
from uni4d_fg.cues.mask_distance import shrunk_mask
from uni4d_fg.results.fusion.background import Background
from uni4d_fg.results.fusion.matching_size import times_finer
from uni4d_fg.results.fusion.multiview.working_frame import WorkingSize
from uni4d_fg.results.nearest import nearest_known

_AROUND_PX = 4.0
"""Standard deviation of the window whose colors a pixel is compared with, working px of the usual size."""
_COLOR_NOISE = 1e-3
"""Least variance of colors, of 1."""
_NONE_AROUND = 0.01
"""A window that holds less than this part of a region says nothing of it."""
_WHOLE = 0.99
STILL = 0.6
"""Pixels of a mask whose depth several frames show with this confidence are taken to stand still."""
_RIM_PX, _RIM_STILL, _MIN_RIM = 2, 0.5, 20
"""A mask is too large if so much of its rim, that wide (alike), looks like what is behind: of masks that fit 0 to 0.3
does, of others 0.6 to 1. With fewer pixels that others see, it is not told."""
_REACH_PX = 6.0
"""Colors of what moves are those farther inside, alike."""
_FARTHEST_PX = 12
"""Masks that are too large reach no farther beyond what moves, and what moves no farther beyond others, alike."""
_USUAL = 0.15
"""Nine tenths of the pixels that move have a confidence below 0.25."""
_LARGEST, _PER_COLOR, _PER_CONFIDENCE = 8.0, 0.3, 0.13
"""Log likelihood ratio of colors at most, and what it and confidence count: fitted to scenes with truth."""
_TRANSFER_NOISE = 2e-3
"""Variance of colors that are looked up in other frames, of 1."""
_ALIKE = 1.5 * float(np.log(_TRANSFER_NOISE / _COLOR_NOISE))
"""Log likelihood ratio of a thing and a scene of one and the same color: they differ in the least variance only."""
_TELLS = 0.1
"""A smaller ratio is rounding."""
_HALF = 0.5
_SMOOTH_PX = 1.5
"""What says that a pixel beside a mask moves is blurred by this, alike."""
_GROWN, _PER_SHARE, _PER_LIKENESS = 0.37, 1.07, 0.24
"""Log odds that it does: a constant, and what the share of its ring and its own colors count; fitted likewise."""


def farthest_px(finer: float) -> int:
    """Return how far masks may reach beyond what moves, and what moves beyond them, px of maps so much finer."""
    return round(_FARTHEST_PX * finer)


class FittedMask(NamedTuple):
    """Where a mask does not fit what moves, (h, w) each."""

    still: BoolArray
    """What stands still inside it; whatever outside."""
    missed: BoolArray
    """What moves outside of it."""

    def applied(self, mask: Int32Array, size: WorkingSize) -> Int32Array:
        """Return the mask (H, W) that fits: what it missed belongs to the instance that is nearest.

        Args:
            mask: (H, W) 0 static.
            size: From (h, w) to (H, W).
        """
        still, missed = (size.enlarge(part.astype(np.float32)) > _HALF for part in self)
        moving = np.where((mask > 0) & still, 0, mask)
        missed &= mask == 0
        if missed.any():
            moving[missed] = mask.ravel()[nearest_known(mask > 0)[missed]]
        return moving


class Compared(NamedTuple):
    """A frame beside its mask and what other frames show of the still scene behind it, (h, w) each."""

    color: Float32Array
    """(h, w, 3) of 1."""
    covered: Float32Array
    """Part of each pixel that is inside a mask."""
    instance: Int32Array
    """In whose."""
    like_background: Float32Array
    """Log likelihood that it is what other frames show there; means nothing where none does."""
    seen: BoolArray
    """Where others show it."""


def compare(image: ImageArray, mask: Int32Array, behind: Background) -> Compared:
    """Compare a frame with what other frames show behind its mask.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W) 0 static.
        behind: (h, w) in masks, and so far around them as they may miss.
    """
    small, covered = _shrunk(image, mask, behind.seen.shape)
    instance = shrunk_mask(mask, (covered.shape[0], covered.shape[1]))
    return Compared(small, covered, instance, _like_background(small, behind), behind.seen)


def fitted_mask(compared: Compared, matched: Float32Array, *, tells_missed: bool) -> FittedMask:
    """Return where a mask is too large and where too small.

    Args:
        compared: The frame.
        matched: (h, w) confidence in the depth that several frames show of what stands still.
        tells_missed: Otherwise it is taken to be large enough.
    """
    still = stands_still(compared, matched)
    return FittedMask(still, moves_beside(compared, matched) if tells_missed else np.zeros_like(still))


def looks_moving(image: ImageArray, mask: Int32Array, static: BoolArray) -> BoolArray:
    """Compare every pixel with the colors inside masks and outside of the band nearby, each a normal distribution.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W) 0 static.
        static: (h, w), at the working size: neither masked nor in the band.

    Returns:
        (h, w) where the colors inside a mask are the likelier ones, among pixels that are not static.
    """
    small, share = _shrunk(image, mask, static.shape)
    inside = share > _WHOLE
    if not inside.any():
        return np.zeros_like(static)
    return ~static & (_log_likelihood(small, inside) > _log_likelihood(small, static))


def stands_still(compared: Compared, matched: Float32Array) -> BoolArray:
    """Return which pixels inside masks stand still, as masks reach beyond what moves.

    What several frames show with confidence does. Where the rim of an instance looks like what other frames show of the
    still scene, its mask is too large. By how much is seen in how many pixels look so, the farther inside the fewer;
    each is then judged by that share, by its own colors, and by its confidence.

    Args:
        compared: The frame.
        matched: (h, w) confidence in the depth that several frames show of what stands still.

    Returns:
        (h, w), whatever outside of masks.
    """
    still = matched > STILL
    inside = compared.covered > _WHOLE
    if not inside.any():
        return still
    depth = cv2.distanceTransform(np.pad(inside.astype(np.uint8), 1, mode="edge"), cv2.DIST_L2, 3)[1:-1, 1:-1]
    finer = times_finer(depth.shape)
    farthest = farthest_px(finer)
    deep = inside & (depth > _REACH_PX * finer)
    ring = np.ceil(depth).astype(np.int64)
    along = inside & (ring <= farthest)
    seen = along & compared.seen
    if not deep.any():
        return still
    like_behind = compared.like_background - _log_likelihood(compared.color, deep)
    # Where nothing deeper inside is near, the colors say nothing.
    told = seen & np.isfinite(like_behind)
    like_behind = np.where(told, np.clip(like_behind, -_LARGEST, _LARGEST), np.float32(0))
    confident = 2 * np.log(np.maximum(matched, np.float32(1e-3)) / np.float32(_USUAL))
    likely = _PER_COLOR * like_behind + _PER_CONFIDENCE * confident
    for label in np.unique(compared.instance[seen]).tolist():
        mine = along & (compared.instance == label)
        rim = like_behind[mine & seen & (ring <= _RIM_PX * finer)]
        if len(rim) < _MIN_RIM or float((rim > 0).mean()) < _RIM_STILL:
            continue
        share = _share_by_ring(ring, farthest, mine & seen, like_behind > 0)
        # Farther inside than the mask is too large, what looks like the scene behind only looks like it.
        reached = mine & (ring <= np.count_nonzero(share >= _RIM_STILL))
        odds = np.log(share / (1 - share))[np.minimum(ring, farthest)]
        still |= reached & (odds + likely > 0)
    return still


def moves_beside(compared: Compared, matched: Float32Array) -> BoolArray:
    """Return which pixels beside masks move, as masks may be smaller than what moves.

    They look like what is inside, and not like what other frames show of the still scene. In how many pixels that is
    so is seen ring by ring, the farther from the mask the fewer; each is then judged by that share and by the colors
    around it. What several frames show with confidence stands still.

    Args:
        compared: The frame.
        matched: (h, w) confidence in the depth that several frames show of what stands still.

    Returns:
        (h, w), outside of masks.
    """
    inside, outside = compared.covered > _WHOLE, compared.covered <= _HALF
    if not inside.any():
        return np.zeros_like(inside)
    ring = np.ceil(cv2.distanceTransform(outside.astype(np.uint8), cv2.DIST_L2, 3)).astype(np.int64)
    finer = times_finer(ring.shape)
    farthest = farthest_px(finer)
    along = outside & (ring <= farthest) & (matched <= STILL)
    seen = along & compared.seen
    like_moving = _log_likelihood(compared.color, inside) - compared.like_background - np.float32(_ALIKE)
    like_moving = np.where(seen, np.clip(like_moving, -_LARGEST, _LARGEST), np.float32(0))
    share = _share_by_ring(ring, farthest, seen, like_moving > _TELLS)
    odds = np.log(share / (1 - share))[np.minimum(ring, farthest)]
    around = cv2.GaussianBlur(like_moving, (0, 0), _SMOOTH_PX * finer)
    return np.asarray(along & (_GROWN + _PER_SHARE * odds + _PER_LIKENESS * around > 0))


def _share_by_ring(ring: IntArray, farthest: int, seen: BoolArray, alike: BoolArray) -> FloatArray:
    """Return in which part of the pixels that are seen something is alike, by their distance, which it falls with."""
    many = np.bincount(ring[seen], minlength=farthest + 1) + 1.0
    share = np.bincount(ring[seen & alike], minlength=farthest + 1) / many
    return np.clip(np.minimum.accumulate(np.append(1.0, share[1:])), 0.02, 0.98)


def _like_background(image: Float32Array, behind: Background) -> Float32Array:
    """Return the log likelihood (h, w) of an image (h, w, 3), of 1, if what other frames show is there."""
    off = cv2.GaussianBlur(image - behind.color, (0, 0), 1.0)
    variance = cv2.GaussianBlur(behind.variance, (0, 0), 1.0) + np.float32(_TRANSFER_NOISE)
    return np.asarray(-0.5 * (off**2 / variance + np.log(variance)).sum(axis=2), np.float32)


def _shrunk(image: ImageArray, mask: Int32Array, shape: tuple[int, ...]) -> tuple[Float32Array, Float32Array]:
    """Return image (h, w, 3), of 1, and the part of each pixel (h, w) that is inside a mask."""
    sides = (shape[1], shape[0])
    small = cv2.resize(image, sides, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255.0)
    covered = cv2.resize((mask > 0).astype(np.float32), sides, interpolation=cv2.INTER_AREA)
    return small, np.asarray(covered, np.float32)


def _log_likelihood(image: Float32Array, region: BoolArray) -> Float32Array:
    """Return that of each pixel (h, w) of an image (h, w, 3), of 1, under the colors of a region nearby."""
    weight, around = region.astype(np.float32), _AROUND_PX * times_finer(region.shape)
    mass = cv2.GaussianBlur(weight, (0, 0), around)
    share = np.maximum(mass, 1e-6)[..., None]
    mean = cv2.GaussianBlur(image * weight[..., None], (0, 0), around) / share
    square = cv2.GaussianBlur(image**2 * weight[..., None], (0, 0), around) / share
    variance = np.maximum(square - mean**2, 0) + np.float32(_COLOR_NOISE)
    value = -0.5 * ((image - mean) ** 2 / variance + np.log(variance)).sum(axis=2)
    return np.where(mass > _NONE_AROUND, value, np.float32(-np.inf)).astype(np.float32)
