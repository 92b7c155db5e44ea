"""Edges of depth, looked at again with the views that a frame was matched with: in C++ or in NumPy."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.multiview.edges_numpy import edges_again_numpy
from uni4d_fg.results.fusion.pixel_transfer import PixelTransfer

_AROUND = np.ones((3, 3), np.uint8)


def edges_again(
    inverse_depth: Float32Array,
    image: Float32Array,
    chosen: BoolArray,
    others: list[Float32Array],
    transfers: list[PixelTransfer],
    threads: int = 0,
) -> Float32Array:
    """Return inverse depth (h, w) in which pixels near edges have the best of the depths around them.

    Pixels choose alone: around those that changed, a median takes single ones out.

    Args:
        inverse_depth: (h, w) 1/m, positive.
        image: (h, w), 0 to 1, NaN where depth is to stay.
        chosen: (h, w) where pixels may change.
        others: V images alike.
        transfers: Where each of them sees the image's pixels.
        threads: Of the C++ version; 0 takes all cores.
    """
    turns, shifts = (np.stack(parts) for parts in zip(*transfers, strict=True))
    core, _ = find_extension()
    if core is None:
        again = edges_again_numpy(inverse_depth, image, chosen, np.stack(others), turns, shifts)
    else:
        again = core.depth_edges(
            inverse_depth.astype(np.float64), image.astype(np.float64), chosen.astype(np.uint8),
            np.stack(others).astype(np.float64), np.ascontiguousarray(turns), np.ascontiguousarray(shifts),
            threads=threads,
        ).astype(np.float32)  # fmt: skip
    changed = cv2.dilate((again != inverse_depth).astype(np.uint8), _AROUND) > 0
    return np.where(changed & chosen & np.isfinite(image), cv2.medianBlur(again, len(_AROUND)), again)
