"""Masks that a segmenter lost for a frame or two, made from the frames beside.

A lost mask lets what moves into the static scene. Where an instance has masks right before and right after a short gap,
both are carried into the gap by dense optical flow and averaged as signed distances to their borders. An instance may
also be gone for a moment: a gap is filled only where the images show the same thing as the frames beside, and where the
masks from both sides agree. A video whose masks are missing often is left alone, since it may be meant so.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.counted import counted
from uni4d_fg.cues.dense_flow import DenseFlow, shrunk_gray, shrunk_size, warp_back, working_scale
from uni4d_fg.frontend.sequence.frames import LazyFrames, where_of
from uni4d_fg.frontend.sequence.model import FrameSource

_LONGER_SIDE_PX = 320
_SPECK = 0.05
"""A mask with less than this part of the area on both sides is missing."""
_LONGEST = 2
"""Frames that a gap lasts at most."""
_MOST = 0.2
"""Part of the frames from an instance's first to its last that may be missing: more is intent, or a poor segmenter."""
_LEAST_PX = 24
"""Area of the masks beside a gap, working px: flow loses what is smaller."""
_AREA_RATIO = 3.0
"""Between the two masks beside a gap, and between a mask and what is carried over of it, at most."""
_SAME_GRAY = 12.0
"""Median difference between the gray levels of a thing in two frames, at most."""
_RETURN_PX = 1.5
"""Distance by which flow there and back misses where it began, working px, at most, for half of the thing."""
_OVERLAP = 0.5
"""Intersection over union of the masks from both sides, at least."""
_FREE = 0.5
"""Part of the carried mask without another instance, at least: the thing may have another number, or be hidden."""
_BAND_PX = 12.0
"""Distances beyond say nothing more, working px."""


@dataclass(frozen=True)
class _Beside:
    """A frame with a mask, beside a gap."""

    gray: ImageArray
    """(h, w) working size."""
    mask: BoolArray
    """(h, w)."""


class RepairedMasks(LazyFrames[Int32Array]):
    """Label maps (H, W) with instances added to some frames; the others are those of the source.

    Args:
        source: T label maps, 0 static.
        distance: Of each repaired frame, the signed distance (h, w) to the border of each added instance, positive
            inside, at working size.
    """

    def __init__(
        self, source: FrameSource[Int32Array], distance: dict[int, dict[int, npt.NDArray[np.float16]]]
    ) -> None:
        self.source, self.distance = source, distance

    @property
    def frames(self) -> list[int]:
        """Repaired frames, ascending."""
        return sorted(self.distance)

    def __len__(self) -> int:
        return len(self.source)

    def where(self, frame: int) -> str:
        """Return where the source has it from."""
        return where_of(self.source, frame)

    def _read(self, frame: int) -> Int32Array:
        mask = self.source[frame]
        added = self.distance.get(frame)
        if added is None:
            return mask
        out = np.array(mask, np.int32)
        nearest = np.zeros(mask.shape, np.float32)
        for label, distance in sorted(added.items()):
            large = cv2.resize(distance.astype(np.float32), mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
            # Never over what the frame's own mask says.
            inside = (large > nearest) & (mask == 0)
            out[inside] = label
            nearest = np.maximum(nearest, np.asarray(large))
        return out


def repair_masks(
    images: FrameSource[ImageArray], masks: FrameSource[Int32Array], image_size: tuple[int, int]
) -> RepairedMasks | None:
    """Make missing masks from those beside; None where none is missing.

    One frame is held at a time, of each instance its areas, and of each repair one small map.

    Args:
        images: T images (H, W, 3), RGB.
        masks: T label maps (H, W), 0 static.
        image_size: (H, W), px.

    Raises:
        InputError: If a frame or mask cannot be read.
    """
    size = shrunk_size(image_size, working_scale(image_size, _LONGER_SIDE_PX))
    flow = DenseFlow()
    distance: dict[int, dict[int, npt.NDArray[np.float16]]] = {}
    for label, area in sorted(_areas(masks, size).items()):
        for first, last in missing_gaps(area):
            sides = [
                _Beside(shrunk_gray(images[at], size), _shrunk(masks[at], size) == label)
                for at in (first - 1, last + 1)
            ]
            for frame in range(first, last + 1):
                gray, others = shrunk_gray(images[frame], size), _shrunk(masks[frame], size)
                found = _between(gray, (others != 0) & (others != label), sides, flow)
                if found is not None:
                    distance.setdefault(frame, {})[label] = found.astype(np.float16)
    return RepairedMasks(masks, distance) if distance else None


def repair_warning(frames: list[int]) -> str:
    """Return what a summary says of repaired frames."""
    listed = ", ".join(map(str, frames[:10])) + (", ..." if len(frames) > 10 else "")
    return (
        f"masks are missing in {counted(len(frames), 'frame')} between frames that have them, and were made from those "
        f"beside (input.repair_masks): {listed}"
    )


def missing_gaps(area: FloatArray) -> list[tuple[int, int]]:
    """Return the first and last frame of each short gap in the masks of an instance, from their areas (T,), px."""
    seen = np.flatnonzero(area > 0)
    if not len(seen):
        return []
    gaps, missing = [], 0
    frame = int(seen[0]) + 1
    while frame < seen[-1]:
        last = frame
        # The mask after a gap is the next that is no speck beside the one before it.
        while last < seen[-1] and area[last] <= _SPECK * area[frame - 1]:
            last += 1
        if last == frame:
            frame += 1
            continue
        sides = area[frame - 1], area[last]
        missing += last - frame
        if (
            last - frame <= _LONGEST
            and min(sides) >= _LEAST_PX
            and max(sides) <= _AREA_RATIO * min(sides)
            and area[frame:last].max() <= _SPECK * min(sides)
        ):
            gaps.append((frame, last - 1))
        frame = last + 1
    return gaps if missing <= _MOST * (seen[-1] - seen[0] + 1) else []


def signed_distance(mask: BoolArray) -> Float32Array:
    """Return the distance (H, W) to the border of a mask, px, positive inside, bounded."""
    if not mask.any():
        return np.full(mask.shape, -_BAND_PX, np.float32)
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
    distance = np.asarray(inside - outside + np.where(mask, -0.5, 0.5), np.float32)
    return np.clip(distance, -_BAND_PX, _BAND_PX)


def _areas(masks: FrameSource[Int32Array], size: tuple[int, int]) -> dict[int, FloatArray]:
    """Return the areas (T,) of each instance, px of working ``size``."""
    areas: dict[int, FloatArray] = {}
    for frame, mask in enumerate(masks):
        labels, counts = np.unique(_shrunk(mask, size), return_counts=True)
        for label, count in zip(labels.tolist(), counts.tolist(), strict=True):
            if label:
                areas.setdefault(label, np.zeros(len(masks)))[frame] = count
    return areas


def _shrunk(mask: Int32Array, size: tuple[int, int]) -> Int32Array:
    """Return the nearest pixels of a label map (H, W) at working ``size``; OpenCV resizes no 64-bit integers."""
    rows, columns = (
        ((np.arange(n) + 0.5) * whole / n).astype(np.int64) for n, whole in zip(size, mask.shape, strict=True)
    )
    return mask[np.ix_(rows, columns)]


def _between(gray: ImageArray, others: BoolArray, sides: list[_Beside], flow: DenseFlow) -> Float32Array | None:
    """Return the signed distance (h, w) of an instance carried into a frame from both sides; None if it is not seen."""
    carried = []
    for side in sides:
        there, back = flow.between(gray, side.gray), flow.between(side.gray, gray)
        distance = warp_back(signed_distance(side.mask), there, -_BAND_PX)
        inside = distance > 0
        area, usual = np.count_nonzero(inside), np.count_nonzero(side.mask)
        if not usual / _AREA_RATIO <= area <= usual * _AREA_RATIO:
            return None
        seen = warp_back(side.gray.astype(np.float32), there)
        returned = [warp_back(np.ascontiguousarray(back[..., axis]), there) + there[..., axis] for axis in (0, 1)]
        if (
            float(np.median(np.abs(seen - gray)[inside])) > _SAME_GRAY
            or float(np.median(np.hypot(*returned)[inside])) > _RETURN_PX
        ):
            return None
        carried.append(distance)
    first, second = (distance > 0 for distance in carried)
    if np.count_nonzero(first & second) < _OVERLAP * np.count_nonzero(first | second):
        return None
    mean = np.asarray((carried[0] + carried[1]) / 2, np.float32)
    inside = mean > 0
    return mean if np.count_nonzero(inside & ~others) >= _FREE * np.count_nonzero(inside) else None
