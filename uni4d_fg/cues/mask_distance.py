"""Masks at working size as signed distances to their borders, which can be carried between frames and averaged."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.cues.dense_flow import shrunk_size, warp_back, working_scale
from uni4d_fg.frontend.sequence.model import FrameSource

_LONGER_SIDE_PX = 320
BAND_PX = 12.0
"""Distances beyond say nothing more, working px."""
_STEPS = 10
"""Per px, in a packed distance."""


def working_size(image_size: tuple[int, int]) -> tuple[int, int]:
    """Return the (height, width) at which masks of images of a size are looked at."""
    return shrunk_size(image_size, working_scale(image_size, _LONGER_SIDE_PX))


def shrunk_mask(mask: Int32Array, size: tuple[int, int]) -> Int32Array:
    """Return the nearest pixels of a label map (H, W) at working ``size``; OpenCV resizes no 64-bit integers."""
    rows, columns = (
        ((np.arange(n) + 0.5) * whole / n).astype(np.int64) for n, whole in zip(size, mask.shape, strict=True)
    )
    return mask[np.ix_(rows, columns)]


def instance_areas(masks: FrameSource[Int32Array], size: tuple[int, int]) -> dict[int, FloatArray]:
    """Return the areas (T,) of each instance, px of working ``size``."""
    areas: dict[int, FloatArray] = {}
    for frame, mask in enumerate(masks):
        labels, counts = np.unique(shrunk_mask(mask, size), return_counts=True)
        for label, count in zip(labels.tolist(), counts.tolist(), strict=True):
            if label:
                areas.setdefault(int(label), np.zeros(len(masks)))[frame] = count
    return areas


def signed_distance(mask: BoolArray) -> Float32Array:
    """Return the distance (h, w) to the border of a mask, px, positive inside, bounded."""
    if not mask.any():
        return np.full(mask.shape, -BAND_PX, np.float32)
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
    distance = np.asarray(inside - outside + np.where(mask, -0.5, 0.5), np.float32)
    return np.clip(distance, -BAND_PX, BAND_PX)


def carried_distance(mask: BoolArray, flow: Float32Array) -> Float32Array:
    """Return the signed distance (h, w) of another frame's mask, by the flow (h, w, 2) to that frame."""
    return warp_back(signed_distance(mask), flow, -BAND_PX)


def shared(first: BoolArray, second: BoolArray) -> float:
    """Return the part of the smaller of two masks that the other has too; 0 where one is empty.

    Unlike intersection over union it does not ask whether both are cut equally large.
    """
    smaller = min(np.count_nonzero(first), np.count_nonzero(second))
    return float(np.count_nonzero(first & second) / smaller) if smaller else 0.0


@dataclass(frozen=True)
class PackedDistance:
    """A signed distance (h, w), to a tenth of a px, without what is far outside."""

    size: tuple[int, int]
    top: int
    left: int
    steps: npt.NDArray[np.int8]

    @classmethod
    def of(cls, distance: Float32Array) -> PackedDistance:
        """Pack a distance of at most :data:`BAND_PX`."""
        steps = np.rint(distance * _STEPS).astype(np.int8)
        rows, columns = (np.flatnonzero((distance > -BAND_PX).any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return cls((distance.shape[0], distance.shape[1]), 0, 0, steps[:0, :0])
        top, left = int(rows[0]), int(columns[0])
        inside = steps[top : rows[-1] + 1, left : columns[-1] + 1]
        return cls((distance.shape[0], distance.shape[1]), top, left, inside.copy())

    def whole(self) -> Float32Array:
        """Return the distance (h, w), px."""
        out = np.full(self.size, -BAND_PX, np.float32)
        height, width = self.steps.shape
        out[self.top : self.top + height, self.left : self.left + width] = self.steps / np.float32(_STEPS)
        return out
