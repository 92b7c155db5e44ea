"""Motion blur of a turning camera: how far it smears an image, and patches that are made as blurred as another image.

While the shutter is open a pan draws every point out to a line along its motion. A window around the point then sees
one end of the line or the other, and a sharp patch is found in it wrong by up to half of the line's length. Two views
that are blurred alike are compared without that error, so the sharper one is blurred as well (Portz, Zhang and Jiang
2012, "Optical flow in the presence of spatially-varying motion blur"). Blur is one vector per image here: its
direction, and the length in pixels over which the light of a point is spread evenly.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray

MARGIN_PX = 12
"""Pixels around a patch that are kept, so that it can be blurred by up to twice that."""
LEAST_BLUR_PX = 1.5
"""Blur below this length changes nothing that is found."""
_COMPARED_PX = 96
"""Longer side, about, of the small images that are compared for the motion of all of them."""
_LEAST_PX = 16
"""Shorter side of small images that show a motion."""
_SAMPLES_PER_PX = 8


def shift_of_all(source: ImageArray, target: ImageArray) -> FloatArray:
    """Return the motion (2,), px, that most of two gray images (H, W) uint8 share; zero for tiny ones.

    By phase correlation of small images.
    """
    # Whole pixels become one, which takes OpenCV a quarter of the time of parts of pixels.
    factor = max(max(source.shape) // _COMPARED_PX, 1)
    height, width = source.shape[0] // factor, source.shape[1] // factor
    if min(height, width) < _LEAST_PX:
        return np.zeros(2)
    size, window = (width, height), cv2.createHanningWindow((width, height), cv2.CV_32F)
    small = [
        cv2.resize(image[: height * factor, : width * factor], size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for image in (source, target)
    ]
    shift, _ = cv2.phaseCorrelate(small[0], small[1], window)
    return np.asarray(factor * np.array(shift))


def missing_blur(own: FloatArray, other: FloatArray) -> FloatArray:
    """Return how views (N, 2) px must be blurred to be as blurred as others (N, 2) px; 0 where they are already.

    Variances of even blur, a twelfth of its length squared, add up.
    """
    length = np.linalg.norm(other, axis=-1)
    more = np.sqrt(np.maximum(length**2 - np.sum(own**2, axis=-1), 0.0))
    wanted = np.where(more >= LEAST_BLUR_PX, more, 0.0) / np.maximum(length, 1e-12)
    return np.asarray(other * wanted[..., None])


def blurred(image: ImageArray, blur: FloatArray) -> ImageArray:
    """Return an image (H, W) uint8 blurred by a vector (2,) px."""
    result: ImageArray = cv2.filter2D(image, -1, _line(blur), borderType=cv2.BORDER_REPLICATE)
    return result


def blurred_patches(patches: ImageArray, blur: FloatArray) -> Float32Array:
    """Return patches (N, S, S) uint8 blurred by a vector (2,) px of up to twice the margin, without their margins."""
    side = patches.shape[1]
    # One below the other they are one image; what one smears into the next stays within the margins, which are cut off.
    image = patches.reshape(-1, side).astype(np.float32)
    smeared = cv2.filter2D(image, -1, _line(blur), borderType=cv2.BORDER_REPLICATE)
    inner = slice(MARGIN_PX, side - MARGIN_PX)
    result: Float32Array = smeared.reshape(-1, side, side)[:, inner, inner]
    return result


def _line(blur: FloatArray) -> FloatArray:
    """Return the kernel that spreads a pixel evenly over a line along a vector (2,) px, centered."""
    length = float(np.linalg.norm(blur))
    reach = int(np.ceil(0.5 * length)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    at = reach + np.linspace(-0.5, 0.5, int(_SAMPLES_PER_PX * length) + 2)[:, None] * blur
    whole = np.floor(at).astype(np.int64)
    part = at - whole
    for right in (0, 1):
        for below in (0, 1):
            weight = np.abs(1 - right - part[:, 0]) * np.abs(1 - below - part[:, 1])
            np.add.at(kernel, (whole[:, 1] + below, whole[:, 0] + right), weight)
    return np.asarray(kernel / kernel.sum())
