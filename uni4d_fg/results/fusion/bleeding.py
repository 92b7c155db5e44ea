"""A depth cue that bleeds across edges: how far it does, where its depth is a mixture, and what takes its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray
from uni4d_fg.results.fusion.log_range import log_range
from uni4d_fg.results.nearest import from_nearest

_EDGE = 0.15
"""Change of log depth over two pixels that is an edge."""
_LONGEST = 0.09
"""Bleeding reaches no farther than this part of the width."""
_LOW, _TO_ITS_END = 0.4, 1.7
"""Where it is the first part of what it is beside the edge is told well; it ends this many times as far away."""
_LEAST = 0.02
"""Less beside the edge is none."""
_MIN_PIXELS = 30
_FARTHEST_MIXED = 5.0
"""The mixture is wrong nearer to an edge than this, working px; what bleeds farther is right to some percent."""
_REBLURRED = 0.6
"""What blurs it once more has this standard deviation, of how far it bleeds ..."""
_PER_CHANGE = 8.0
"""... and the cue is off by this many times what that changes, on scenes with truth."""
_LEAST_RATIO = 0.5
"""A change by more is none of blurring."""
_RAMP = 0.25
"""Change of log depth across which a cue that bleeds is a mixture."""


@dataclass(frozen=True)
class EdgeProfile:
    """How a cue and the true depth differ beside the depth edges of a frame, by the distance from them, working px."""

    count: FloatArray
    """(D,) pixels at a distance of 0 to D - 1 px."""
    total: FloatArray
    """(D,) log depth by which what is near is too far in them, and what is far too near, summed."""


def edge_profile(log_cue: Float32Array, log_depth: Float32Array, sure: BoolArray) -> EdgeProfile | None:
    """Measure a cue beside depth edges.

    Args:
        log_cue: (h, w) affinely corrected, NaN where missing.
        log_depth: (h, w) of the static scene from several views.
        sure: (h, w) where that is to be believed.

    Returns:
        The profile; None if the frame has no edges.
    """
    edge = (log_range(log_depth, np.ones((3, 3), np.uint8)) > _EDGE) & sure
    if not edge.any():
        return None
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 3)
    reach = max(3, round(_LONGEST * log_cue.shape[1]))
    around = cv2.blur(log_depth, (2 * reach + 1,) * 2)
    usable = sure & np.isfinite(log_cue)
    inwards = (log_depth - np.where(usable, log_cue, np.float32(0))) * np.sign(log_depth - around)
    bins = np.minimum(distance[usable], reach).astype(np.int64)
    count = np.bincount(bins, minlength=reach + 1)[:reach]
    total = np.bincount(bins, inwards[usable], minlength=reach + 1)[:reach]
    return EdgeProfile(count.astype(np.float64), np.asarray(total, dtype=np.float64))


def bleeding_radius(profiles: Sequence[EdgeProfile]) -> float:
    """Measure how far a cue bleeds across depth edges, from the profiles of some frames.

    Bleeding makes what is near beside an edge too far, and what is far too near; other errors do not know which is
    which, and cancel in the mean over the edges of the frames. What does not, lies above the profile's far half, too.

    Returns:
        Working px, 0 if it does not bleed; NaN if the frames have too few edges to tell.
    """
    count = np.sum([profile.count for profile in profiles], axis=0)
    if not profiles or (count < _MIN_PIXELS).any():
        return float("nan")
    profile = np.sum([profile.total for profile in profiles], axis=0) / count
    profile -= np.median(profile[len(profile) // 2 :])
    top = int(np.argmax(profile[:3]))
    if profile[top] < _LEAST:
        return 0.0
    low = _LOW * profile[top]
    first = top + int(np.argmax(profile[top:] < low))  # there is one: half of the far half is below 0
    before = profile[first - 1]
    return float(_TO_ITS_END * (first - 1 + (before - low) / (before - profile[first])))


def across_edges(log_cue: Float32Array, radius_px: float) -> BoolArray:
    """Return where a cue that bleeds mixes two surfaces, (h, w).

    Args:
        log_cue: (h, w), NaN where missing.
        radius_px: How far it bleeds, working px.
    """
    side = 2 * round(min(radius_px, _FARTHEST_MIXED)) + 1
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(log_range(log_cue, np.asarray(window, np.uint8)) > _RAMP)


def mixing_sigma(log_cue: Float32Array, radius_px: float) -> Float32Array:
    """Return by how much a cue that bleeds is off for it, (h, w): a standard deviation of log depth.

    What blurring did to it shows in what blurring it once more does: planes, whose inverse depth is linear, stay as
    they are, and edges change as they have changed before.

    Args:
        log_cue: (h, w), NaN where missing.
        radius_px: How far it bleeds, working px.
    """
    known = np.isfinite(log_cue)
    if not known.any():
        return np.zeros_like(log_cue)
    sigma = _REBLURRED * min(radius_px, _FARTHEST_MIXED)
    margin = min(int(np.ceil(3 * sigma)), min(log_cue.shape) - 1)
    inverse = np.exp(-from_nearest(np.where(known, log_cue, np.float32(0)), known))
    # Continued so that a plane goes on beyond the border.
    padded = np.pad(inverse, margin, mode="reflect", reflect_type="odd")
    again = cv2.GaussianBlur(padded, (0, 0), sigma)[margin : -margin or None, margin : -margin or None]
    change = np.log(np.maximum(again / inverse, _LEAST_RATIO))
    return np.asarray(_PER_CHANGE * np.sqrt(cv2.GaussianBlur(change**2, (0, 0), sigma)), np.float32)
