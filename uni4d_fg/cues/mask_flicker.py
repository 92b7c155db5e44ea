"""Masks that grow and shrink from frame to frame, averaged over the frames beside.

A segmenter may put a border too far out in one frame and too far in in the next. The masks of the frames beside,
carried over by dense optical flow, tell where it lies on average. Masks that agree with those of their neighbors but
for their normal noise are not touched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, ImageArray, Int32Array, evenly_spread
from uni4d_fg.cues.dense_flow import DenseFlow, shrunk_gray
from uni4d_fg.cues.mask_distance import PackedDistance, carried_distance, shared, shrunk_mask, signed_distance
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.optim.threads import map_in_order, thread_count

_UNSTABLE_PX, _MOST_PX = 1.7, 4.0
"""Borders that are as far from those of the frames beside as the first, in the mean over the frames, flicker: working
px. Masks of good segmenters, and true ones, stay below 1. Not the median: masks that are cut too large, or too small,
for some frames are alike there. No frame counts for more than the second: a thing may be hidden for a moment."""
_NOT_FOLLOWED = 0.8
"""Part of that which is left when flow carries the masks of the frames beside, at least: what is less, a thing that
really grows and shrinks, is seen by flow too."""
_LEAST_FRAMES = 8
_LEAST_PX = 24
"""Area of a mask, working px."""
_REACH = 2
"""Frames before and after that are averaged."""
_TOGETHER = 8
"""Frames of each thread that are held at a time."""
_SAMPLE = 48
"""Frames of an instance that are looked at before all are: flow is dear, and most masks are sound."""
_SHARED = 0.6
"""Part of a mask, or of one that is carried over if that is smaller, that the other has too: where it is less, flow has
failed. One may be cut larger all around, which is what is looked for."""


def may_flicker(area: FloatArray) -> bool:
    """Tell from the areas (T,) of an instance, working px, whether it is worth a look with optical flow."""
    sides = [area[1:-1], area[:-2], area[2:]]
    kept = np.min(sides, axis=0) >= _LEAST_PX if len(area) > 2 else np.zeros(0, bool)
    if np.count_nonzero(kept) < _LEAST_FRAMES:
        return False
    own, before, after = (part[kept] for part in sides)
    # A border is at least as long as that of a disk, so that this is an upper bound of its way.
    return _usual(np.abs(own - (before + after) / 2) / np.sqrt(4 * np.pi * own)) > _UNSTABLE_PX


def averaged_masks(
    images: FrameSource[ImageArray], masks: FrameSource[Int32Array], areas: Mapping[int, FloatArray],
    size: tuple[int, int],
) -> dict[int, dict[int, PackedDistance]]:  # fmt: skip
    """Return what is averaged of those of some instances that flicker.

    Args:
        images: T images (H, W, 3), RGB.
        masks: T label maps (H, W).
        areas: Of the instances to look at, (T,), working px.
        size: Working size.

    Returns:
        By instance and frame the averaged signed distance (h, w) to its border; nothing for instances that do not
        flicker.

    Raises:
        InputError: If a frame or mask cannot be read.
    """
    labels, sample = list(areas), _sampled(areas)
    if 2 * len(sample) < len(masks):
        _, ways = _averages(images, masks, labels, size, sample)
        labels = [label for label in labels if _flickers(ways[label])]
    averages, ways = _averages(images, masks, labels, size, range(len(masks)) if labels else ())
    return {label: averages[label] for label in labels if _flickers(ways[label])}


def _sampled(areas: Mapping[int, FloatArray]) -> list[int]:
    """Return frames, ascending, with up to :data:`_SAMPLE` of those in which each instance is there."""
    frames: set[int] = set()
    for area in areas.values():
        there = np.flatnonzero(area >= _LEAST_PX)
        frames.update(there[evenly_spread(len(there), _SAMPLE)].tolist())
    return sorted(frames)


def _averages(
    images: FrameSource[ImageArray], masks: FrameSource[Int32Array], labels: list[int], size: tuple[int, int],
    frames: Sequence[int],
) -> tuple[dict[int, dict[int, PackedDistance]], dict[int, list[tuple[float, float]]]]:  # fmt: skip
    """Return by instance what :func:`_averaged` finds in some frames, ascending: distances by frame, and ways."""
    averages: dict[int, dict[int, PackedDistance]] = {label: {} for label in labels}
    ways: dict[int, list[tuple[float, float]]] = {label: [] for label in labels}
    near: dict[int, tuple[ImageArray, Int32Array]] = {}
    threads = thread_count()
    for first in range(0, len(frames), _TOGETHER * threads):
        together = list(frames[first : first + _TOGETHER * threads])
        wanted = sorted(
            {
                beside
                for frame in together
                for beside in range(max(frame - _REACH, 0), min(frame + _REACH + 1, len(masks)))
            }
        )
        near = {
            number: near.get(number) or (shrunk_gray(images[number], size), shrunk_mask(masks[number], size))
            for number in wanted
        }
        for frame, found in zip(
            together, map_in_order(partial(_averaged, near, labels), together, threads), strict=True
        ):
            for label, (mean, way) in found.items():
                averages[label][frame] = mean
                ways[label] += way
    return averages, ways


def _averaged(
    near: Mapping[int, tuple[ImageArray, Int32Array]], labels: list[int], frame: int
) -> dict[int, tuple[PackedDistance, list[tuple[float, float]]]]:
    """Average the masks of a frame with those of the frames beside.

    Args:
        near: Gray (h, w) and label map (h, w) of the frame and of those beside.
        labels: Instances to look at.
        frame: Its number.

    Returns:
        By instance that is there, the mean distance, and, if flow follows it before and after, how far its border is
        from those beside, as they are and by flow.
    """
    flow = DenseFlow()  # none is shared: threads would write into each other's buffers
    gray, mask = near[frame]
    present = [label for label in labels if np.count_nonzero(mask == label) >= _LEAST_PX]
    beside = [other for other in range(frame - _REACH, frame + _REACH + 1) if other in near and other != frame]
    flows = {other: flow.between(gray, near[other][0]) for other in beside} if present else {}
    found: dict[int, tuple[PackedDistance, list[tuple[float, float]]]] = {}
    for label in present:
        own: BoolArray = mask == label
        distance = signed_distance(own)
        carried = {}
        for other, shift in flows.items():
            there = near[other][1] == label
            if np.count_nonzero(there) >= _LEAST_PX:
                moved = carried_distance(there, shift)
                if shared(own, moved > 0) >= _SHARED:
                    carried[other] = moved
        way: list[tuple[float, float]] = []
        if frame - 1 in carried and frame + 1 in carried:
            border = max(1.0, np.count_nonzero(np.abs(distance) < 1.0) / 2)
            usual = [
                sum(np.count_nonzero(part) for part in parts) / 2
                for parts in zip(
                    *((near[other][1] == label, carried[other] > 0) for other in (frame - 1, frame + 1)),
                    strict=True,
                )
            ]
            as_given, by_flow = (abs(np.count_nonzero(own) - area) / border for area in usual)
            way.append((float(as_given), float(by_flow)))
        mean = np.mean([distance, *carried.values()], axis=0)
        found[label] = PackedDistance.of(np.asarray(mean, np.float32)), way
    return found


def _flickers(ways: list[tuple[float, float]]) -> bool:
    """Tell from how far the border is from those beside, as they are and by flow, per frame, whether it flickers."""
    if len(ways) < _LEAST_FRAMES:
        return False
    as_given, by_flow = np.asarray(ways).T
    return _usual(by_flow) > _UNSTABLE_PX and bool(np.median(by_flow) >= _NOT_FOLLOWED * np.median(as_given))


def _usual(way: FloatArray) -> float:
    return float(np.minimum(way, _MOST_PX).mean())
