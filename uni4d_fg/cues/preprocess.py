"""From an image to what a network takes, and back from its pixels to those of the image.

Resampling follows pixel areas: pixel x of the image, whose center is x, lies at ``(x + 0.5) * scale - 0.5 + offset``
in the network's image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray
from uni4d_fg.cues.card import InputSpec, SizeSpec

_TYPES = {"float32": np.float32, "float16": np.float16, "uint8": np.uint8}


@dataclass(frozen=True)
class Placement:
    """Where an image lies in the input of a network. All sizes are (height, width), px."""

    image_size: tuple[int, int]
    input_size: tuple[int, int]
    content: tuple[int, int, int, int]
    """Top, left, height, width of the image in the input; the rest is padding."""

    @property
    def scale(self) -> FloatArray:
        """(2,) pixels of the input per pixel of the image, along x and y."""
        _, _, height, width = self.content
        return np.array([width / self.image_size[1], height / self.image_size[0]])

    def to_input(self, uv: FloatArray) -> FloatArray:
        """Map (..., 2) pixels of the image to pixels of the input (centers at integers in both)."""
        top, left = self.content[:2]
        at_input: FloatArray = (uv + 0.5) * self.scale - 0.5 + np.array([left, top])
        return at_input

    def to_image(self, uv: FloatArray) -> FloatArray:
        """Map (..., 2) pixels of the input to pixels of the image."""
        top, left = self.content[:2]
        at_image: FloatArray = (uv + 0.5 - np.array([left, top])) / self.scale - 0.5
        return at_image

    def intrinsics_to_image(self, intrinsics: FloatArray) -> FloatArray:
        """Map (4,) fx, fy, cx, cy of the input to those of the image."""
        center = self.to_image(intrinsics[2:])
        return np.concatenate((intrinsics[:2] / self.scale, center))

    def restore(self, values: npt.NDArray[Any]) -> Float32Array:
        """Bring a map of the input, at whatever resolution it came out, to the size of the image.

        Args:
            values: (h, w) over the whole input; NaN and infinite where nothing is known.

        Returns:
            (H, W) float32, interpolated between known values; NaN where the nearest one is not known.
        """
        rows, columns = values.shape[0] / self.input_size[0], values.shape[1] / self.input_size[1]
        top, left, height, width = self.content
        # A map of another resolution need not divide evenly: the cut falls on whole pixels of it.
        y0, y1 = _cut(top * rows, (top + height) * rows, values.shape[0])
        x0, x1 = _cut(left * columns, (left + width) * columns, values.shape[1])
        return resize_known(values[y0:y1, x0:x1].astype(np.float32), self.image_size)


def resize_known(values: Float32Array, size: tuple[int, int]) -> Float32Array:
    """Resize a map to (height, width) by linear interpolation among finite values; NaN where there are none."""
    if values.shape == size:
        return np.where(np.isfinite(values), values, np.float32(np.nan))
    known = np.isfinite(values)
    target = (size[1], size[0])
    if known.all():
        whole: Float32Array = cv2.resize(values, target, interpolation=cv2.INTER_LINEAR)
        return whole
    weighted = cv2.resize(np.where(known, values, np.float32(0)), target, interpolation=cv2.INTER_LINEAR)
    weight = cv2.resize(known.astype(np.float32), target, interpolation=cv2.INTER_LINEAR)
    sure = weight > 0.5
    out = np.full(size, np.nan, np.float32)
    np.divide(weighted, weight, out=out, where=sure)
    return out


def place(image_size: tuple[int, int], size: SizeSpec) -> Placement:
    """Decide where an image of (height, width) goes in the input of a network."""
    height, width = image_size
    if size.rule == "fixed":
        assert size.height is not None and size.width is not None  # noqa: PT018 - checked by the card
        target = (size.height, size.width)
        if not size.keep_aspect:
            return Placement(image_size, target, (0, 0, *target))
        factor = min(target[0] / height, target[1] / width)
        inner = (min(target[0], max(1, round(height * factor))), min(target[1], max(1, round(width * factor))))
        spare = (target[0] - inner[0], target[1] - inner[1])
        top, left = (spare[0] // 2, spare[1] // 2) if size.pad == "center" else (0, 0)
        return Placement(image_size, target, (top, left, *inner))
    factor = 1.0
    if size.rule != "image":
        assert size.length is not None
        factor = size.length / (max(image_size) if size.rule == "longest" else min(image_size))
    rounded = [_multiple(side * factor, size.multiple_of) for side in image_size]
    target = (rounded[0], rounded[1])
    return Placement(image_size, target, (0, 0, *target))


def prepare(image: ImageArray, placement: Placement, spec: InputSpec, size: SizeSpec) -> npt.NDArray[Any]:
    """Return an image as one item of a batch: (C, h, w) or (h, w, C) as the card says, without the batch axis.

    Args:
        image: (H, W, 3) uint8 RGB of ``placement.image_size``.
        placement: From :func:`place`.
        spec: Colors, scale and layout.
        size: Color of the padding.
    """
    top, left, height, width = placement.content
    shrinks = height < image.shape[0] or width < image.shape[1]
    pixels = image
    if (height, width) != image.shape[:2]:
        method = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
        pixels = cv2.resize(image, (width, height), interpolation=method)
    canvas = pixels.astype(np.float32)
    if (height, width) != placement.input_size:
        canvas = np.empty((*placement.input_size, 3), np.float32)
        canvas[:] = np.asarray(size.pad_color, np.float32)
        canvas[top : top + height, left : left + width] = pixels
    if spec.color == "bgr":
        canvas = canvas[:, :, ::-1]
    if spec.type != "uint8":
        mean, std = np.array(spec.mean, np.float32), np.array(spec.std, np.float32)
        canvas = ((canvas * np.float32(spec.scale) - mean) / std).astype(np.float32)
    ordered = canvas.transpose(2, 0, 1) if spec.layout == "NCHW" else canvas
    return np.ascontiguousarray(ordered).astype(_TYPES[spec.type])


def input_shape(spec: InputSpec, size: SizeSpec) -> tuple[int | None, ...]:
    """Return the shape (with the batch axis) of the input of one image; None where it depends on the image."""
    fixed = (size.height, size.width) if size.rule == "fixed" else (None, None)
    return (1, 3, *fixed) if spec.layout == "NCHW" else (1, *fixed, 3)


def _multiple(side: float, of: int) -> int:
    return max(of, of * math.floor(side / of + 0.5))


def _cut(begin: float, end: float, limit: int) -> tuple[int, int]:
    first = min(max(round(begin), 0), limit - 1)
    return first, min(max(round(end), first + 1), limit)
