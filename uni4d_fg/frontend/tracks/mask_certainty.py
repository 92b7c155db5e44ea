"""Which pixels of a label map can be trusted: away from the borders of the objects in it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Int32Array

UNCERTAIN = -1
"""Value of a pixel in the band around a border."""


def certain_labels(mask: Int32Array, band_static_px: int, band_dynamic_px: int) -> Int32Array:
    """Mark the uncertain band around every border of a label map.

    A static pixel is certain when the disc of radius ``band_static_px`` around it holds no object, a pixel of
    an instance when the disc of radius ``band_dynamic_px`` holds nothing else; two instances that touch have
    a band between them too. The image border is no border: what lies outside is taken to continue.

    Args:
        mask: (H, W) 0 static, > 0 instance.
        band_static_px: Width of the band on the static side, px.
        band_dynamic_px: Width of the band on the object's side, px.

    Returns:
        (H, W) int32: the label where it is certain, :data:`UNCERTAIN` elsewhere.
    """
    # The smallest and the largest label in a disc say whether it is uniform, for all instances at once.
    static_disc = _disc(band_static_px)
    dynamic_disc = _disc(band_dynamic_px)
    labels: npt.NDArray[np.uint16] | npt.NDArray[np.float64] = (
        mask.astype(np.uint16) if int(mask.max(initial=0)) < 2**16 else mask.astype(np.float64)
    )
    certain_static = cv2.dilate(labels, static_disc) == 0
    uniform = cv2.dilate(labels, dynamic_disc) == cv2.erode(labels, dynamic_disc)
    certain_dynamic = (mask > 0) & uniform
    certain: Int32Array = np.where(certain_static | certain_dynamic, mask, UNCERTAIN).astype(np.int32)
    return certain


def _disc(radius: int) -> npt.NDArray[np.uint8]:
    """Return a symmetric disc-shaped structuring element of side 2 radius + 1."""
    offset = np.arange(-radius, radius + 1)
    # Half a pixel more than the radius gives rounder small discs.
    inside = offset[:, None] ** 2 + offset[None, :] ** 2 <= (radius + 0.5) ** 2
    return inside.astype(np.uint8)
