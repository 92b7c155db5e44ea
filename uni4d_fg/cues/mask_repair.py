"""Masks that a segmenter lost for a frame or two, made from the frames beside.

A lost mask lets what moves into the static scene. Where an instance has masks right before and right after a short gap,
both are carried into the gap by dense optical flow and averaged as signed distances to their borders. An instance may
also be gone for a moment: a gap is filled only where the images show the same thing as the frames beside, and where the
masks from both sides agree. A video whose masks are missing often is left alone, since it may be meant so.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.counted import counted
from uni4d_fg.cues.dense_flow import DenseFlow, shrunk_gray, warp_back
from uni4d_fg.cues.mask_distance import (
    PackedDistance,
    carried_distance,
    instance_areas,
    shared,
    shrunk_mask,
    working_size,
)
from uni4d_fg.cues.mask_flicker import averaged_masks, may_flicker
from uni4d_fg.frontend.sequence.frames import LazyFrames, where_of
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.sequence.problems import some_of

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
_SHARED = 2 / 3
"""Part of the smaller of the masks from both sides that the other has too, at least: one may be cut larger."""
_FREE = 0.5
"""Part of the carried mask without another instance, at least: the thing may have another number, or be hidden."""


@dataclass(frozen=True)
class _Beside:
    """A frame with a mask, beside a gap."""

    gray: ImageArray
    """(h, w) working size."""
    mask: BoolArray
    """(h, w)."""


class RepairedMasks(LazyFrames[Int32Array]):
    """Label maps (H, W) with instances added to some frames, or drawn anew; the others are those of the source.

    Args:
        source: T label maps, 0 static.
        made: Of each frame in which masks were missing, the instances that are added, by their distances.
        averaged: Of each instance that flickers, its new distances by frame.
    """

    def __init__(
        self, source: FrameSource[Int32Array], made: dict[int, dict[int, PackedDistance]],
        averaged: dict[int, dict[int, PackedDistance]] | None = None,
    ) -> None:  # fmt: skip
        self.source, self.made, self.averaged = source, made, averaged or {}

    @property
    def frames(self) -> list[int]:
        """Frames in which masks were missing, ascending."""
        return sorted(self.made)

    @property
    def instances(self) -> list[int]:
        """Instances whose masks were averaged, ascending."""
        return sorted(self.averaged)

    def fingerprint(self) -> str:
        """Return a hash of what differs from the source: optical flow may depend on the machine."""
        digest = hashlib.blake2b(digest_size=16)
        for changes in (self.made, self.averaged):
            for one, distances in sorted(changes.items()):
                for other, distance in sorted(distances.items()):
                    digest.update(f"{one} {other} {distance.top} {distance.left} {distance.steps.shape}".encode())
                    digest.update(distance.steps.tobytes())
        return digest.hexdigest()

    def __len__(self) -> int:
        return len(self.source)

    def where(self, frame: int) -> str:
        """Return where the source has it from."""
        return where_of(self.source, frame)

    def _read(self, frame: int) -> Int32Array:
        mask = self.source[frame]
        again = {label: at[frame] for label, at in self.averaged.items() if frame in at}
        drawn = self.made.get(frame, {}) | again
        if not drawn:
            return mask
        out = np.array(mask, np.int32)
        for label in again:
            out[out == label] = 0
        free = out == 0  # never over what the frame's own mask says of others
        nearest = np.zeros(mask.shape, np.float32)
        for label, distance in sorted(drawn.items()):
            large = cv2.resize(distance.whole(), mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
            inside = (large > nearest) & free
            out[inside] = label
            nearest = np.maximum(nearest, np.asarray(large))
        return out


def repair_masks(
    images: FrameSource[ImageArray], masks: FrameSource[Int32Array], image_size: tuple[int, int]
) -> RepairedMasks | None:
    """Make missing masks from those beside, and average those that flicker; None where nothing is wrong.

    A few frames are held at a time, of each instance its areas, and of each change one small map.

    Args:
        images: T images (H, W, 3), RGB.
        masks: T label maps (H, W), 0 static.
        image_size: (H, W), px.

    Raises:
        InputError: If a frame or mask cannot be read.
    """
    size = working_size(image_size)
    areas = instance_areas(masks, size)
    made = _made_masks(images, masks, areas, size)
    whole = RepairedMasks(masks, made) if made else masks
    suspects = {label: area for label, area in sorted(areas.items()) if may_flicker(area)}
    averaged = averaged_masks(images, whole, suspects, size) if suspects else {}
    return RepairedMasks(masks, made, averaged) if made or averaged else None


def _made_masks(
    images: FrameSource[ImageArray], masks: FrameSource[Int32Array], areas: dict[int, FloatArray], size: tuple[int, int]
) -> dict[int, dict[int, PackedDistance]]:
    """Return by frame the instances whose masks are missing there, as they are carried over."""
    flow = DenseFlow()
    made: dict[int, dict[int, PackedDistance]] = {}
    for label, area in sorted(areas.items()):
        for first, last in missing_gaps(area):
            sides = [
                _Beside(shrunk_gray(images[at], size), shrunk_mask(masks[at], size) == label)
                for at in (first - 1, last + 1)
            ]
            for frame in range(first, last + 1):
                gray, others = shrunk_gray(images[frame], size), shrunk_mask(masks[frame], size)
                found = _between(gray, (others != 0) & (others != label), sides, flow)
                if found is not None:
                    made.setdefault(frame, {})[label] = PackedDistance.of(found)
    return made


def repair_warnings(repaired: RepairedMasks) -> list[str]:
    """Return what a summary says of repaired masks."""
    warnings, frames = [], repaired.frames
    if frames:
        warnings.append(
            f"masks are missing in {counted(len(frames), 'frame')} between frames that have them, and were made from "
            f"those beside (input.repair_masks): {some_of(frames, 10)}"
        )
    if repaired.instances:
        warnings.append(
            "masks grow and shrink from frame to frame, and were averaged over the frames beside "
            f"(input.repair_masks): {'instance' if len(repaired.instances) == 1 else 'instances'} "
            f"{some_of(repaired.instances, 10)}"
        )
    return warnings


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


def _between(gray: ImageArray, others: BoolArray, sides: list[_Beside], flow: DenseFlow) -> Float32Array | None:
    """Return the signed distance (h, w) of an instance carried into a frame from both sides; None if it is not seen."""
    carried = []
    for side in sides:
        there, back = flow.between(gray, side.gray), flow.between(side.gray, gray)
        distance = carried_distance(side.mask, there)
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
    if shared(first, second) < _SHARED:
        return None
    mean = np.asarray((carried[0] + carried[1]) / 2, np.float32)
    inside = mean > 0
    return mean if np.count_nonzero(inside & ~others) >= _FREE * np.count_nonzero(inside) else None
