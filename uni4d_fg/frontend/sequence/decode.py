"""Decoding one image, depth map or mask file, with an error that names the file when that fails."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from uni4d_fg.arrays import Float32Array, ImageArray, Int32Array
from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npy
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.reading import MAX_IMAGE_BYTES, read_bytes

SATURATED = 65535
"""Value of a 16-bit depth file that means "too far to say"; read as missing."""

MIN_16_BIT_RANGE = 4096
"""A 16-bit video whose first image stays below this is taken for one of fewer bits, which would come out black."""

MAX_PIXELS = 2**27
"""Pixels of one image or map above which it is refused (134 million)."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"


def _cut_short(data: bytes) -> bool:
    """Tell whether a PNG or JPEG lacks its end.

    Some decoders fill the rest with gray and say nothing; OpenCV's sets aside what a chunk of a PNG announces, up to
    4 GB, before it finds that the file has less.
    """
    if data.startswith(_PNG_SIGNATURE):
        at = len(_PNG_SIGNATURE)
        while at + 8 <= len(data):
            if data[at + 4 : at + 8] == b"IEND":
                return False
            at += 12 + int.from_bytes(data[at : at + 4], "big")  # length, name, checksum
        return True
    if data.startswith(_JPEG_START):
        return data.rfind(_JPEG_END) < data.rfind(_JPEG_SCAN)
    return False


def _decode(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> npt.NDArray[Any]:
    """Return the pixels of an image file: (H, W) or (H, W, channels), channels BGR(A); by default as stored."""
    remedy = "replace the file or export it again"
    data = read_bytes(path, MAX_IMAGE_BYTES, "an image file")
    if not data:
        raise SequenceProblem(path, "is empty", remedy)
    if _cut_short(data):
        raise SequenceProblem(path, f"is cut short or damaged ({len(data)} bytes)", remedy)
    _check_pixels(path, data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except (cv2.error, MemoryError) as error:
        raise SequenceProblem(path, "cannot be decoded as an image", remedy) from error
    if pixels is None:
        raise SequenceProblem(path, "cannot be decoded as an image", remedy)
    return np.asarray(pixels)


def _check_pixels(path: Path, data: bytes) -> None:
    """Refuse an image whose header announces more pixels than any camera takes, before memory is set aside for them."""
    size = _announced_size(data)
    if size is None:
        return  # the decoder says what is wrong with it
    width, height = size
    if width * height > MAX_PIXELS:
        raise SequenceProblem(
            path, f"announces {width} x {height} px, more than {MAX_PIXELS} in all", "make the images smaller"
        )


def _announced_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height, px, as the header says; None if it cannot be read."""
    if data.startswith(_PNG_SIGNATURE) and data[12:16] == b"IHDR":
        # A video is thousands of these, and Pillow takes as long for the header as the decoder for a small mask.
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as image:
                return image.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None


def read_image(path: Path) -> ImageArray:
    """Read a color image, upright.

    Gray images become RGB, 16-bit images are scaled to 8 bits, alpha is dropped, and an EXIF orientation is
    applied, as every viewer does.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        InputError: If the file cannot be decoded or holds something else than 8 or 16 bits per channel.
    """
    pixels = _decode(path, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    if pixels.dtype == np.uint16:
        pixels = np.rint(pixels / 257.0).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise SequenceProblem(path, f"has pixels of type {pixels.dtype}", "save it with 8 bits per channel")
    if pixels.ndim == 2:
        return np.repeat(pixels[:, :, None], 3, axis=2)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))


def check_bit_depth(path: Path, *others: Path) -> None:
    """Raise InputError if the 16-bit images among some of a video use so few of their values that they would be black.

    One bright image among them is enough: a video may begin or end in the dark.
    """
    brightest = []
    for one in (path, *others):
        try:
            pixels = _decode(one, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
        except InputError:
            if one is path:
                raise
            continue  # said when it is used
        if pixels.dtype == np.uint16:
            brightest.append((int(pixels.max(initial=0)), one))
    value, darkest = max(brightest, key=lambda found: found[0], default=(MIN_16_BIT_RANGE, path))
    if value < MIN_16_BIT_RANGE:
        raise SequenceProblem(
            darkest,
            f"is a 16-bit image whose brightest value is {value} of 65535, next to black",
            "scale all images by one factor to the whole range, or save them with 8 bits",
        )


def is_16_bit_png(path: Path) -> bool:
    """Tell whether a file begins as a PNG of 16 bits per channel does."""
    try:
        with open(path, "rb") as stream:
            start = stream.read(25)
    except OSError:
        return False
    return start.startswith(_PNG_SIGNATURE) and start[24:] == b"\x10"


def clean_depth(depth: npt.NDArray[Any]) -> Float32Array:
    """Return a float32 copy of a depth map (meters) in which zero, negative and infinite values are NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        cleaned: Float32Array = depth.astype(np.float32)
        cleaned[~(np.isfinite(cleaned) & (cleaned > 0))] = np.nan
    return cleaned


def read_depth(path: Path, units_per_meter: float = 1000.0) -> Float32Array:
    """Read a depth map from a 16-bit PNG or a ``.npy`` file.

    Args:
        path: A PNG whose values divided by ``units_per_meter`` are meters (0 and 65535 mean missing), or a
            ``.npy`` file of shape (H, W) or (1, H, W) in meters.
        units_per_meter: 1000 for millimeters, 256 for KITTI, 5000 for TUM and Bonn.

    Returns:
        (H, W) float32 meters, NaN where missing.

    Raises:
        InputError: If the file cannot be read or is not a depth map.
    """
    if path.suffix.lower() == ".npy":
        values = _load_map(path)
        if values.ndim == 3 and values.shape[0] == 1:
            values = values[0]
        if values.ndim != 2 or values.dtype.kind != "f":
            raise SequenceProblem(
                path, f"has shape {values.shape} of {values.dtype}", "save it as (H, W) floats in meters"
            )
        return clean_depth(values)
    pixels = _decode(path)
    if pixels.ndim != 2 or pixels.dtype != np.uint16:
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        raise SequenceProblem(
            path,
            f"has {channels} channel(s) of {pixels.dtype}, not one of 16 bits: a picture of depth is not depth",
            "save depth as 16-bit PNG in millimeters",
        )
    depth = clean_depth(pixels / np.float32(units_per_meter))
    depth[pixels == SATURATED] = np.nan
    return depth


def _load_map(path: Path) -> npt.NDArray[Any]:
    """Return one map of a ``.npy`` file; it is read only when its values are used, after its shape was looked at."""
    values = load_npy(path, memory_map=True)
    if values.size > MAX_PIXELS:
        raise SequenceProblem(path, f"has shape {values.shape}, more than {MAX_PIXELS} pixels", "make the maps smaller")
    return values


def read_mask(path: Path) -> Int32Array:
    """Read a label map.

    Args:
        path: A one-channel PNG (value = id), a three-channel 8-bit PNG (id = R + 256 G + 65536 B; alpha is
            dropped) or a ``.npy`` file of (H, W) integers.

    Returns:
        (H, W) int32 ids; 0 is static.

    Raises:
        InputError: If the file cannot be read or is not a label map.
    """
    if path.suffix.lower() == ".npy":
        values = _load_map(path)
        if values.ndim != 2 or values.dtype.kind not in "biu":
            raise SequenceProblem(path, f"has shape {values.shape} of {values.dtype}", "save it as (H, W) integer ids")
        if values.size and (int(values.min()) < 0 or int(values.max()) > np.iinfo(np.int32).max):
            raise SequenceProblem(
                path, f"has ids from {values.min()} to {values.max()}", "use ids from 0 to 2147483647"
            )
        return values.astype(np.int32)
    pixels = _decode(path)
    if pixels.ndim == 2 and pixels.dtype in (np.uint8, np.uint16):
        return pixels.astype(np.int32)
    if pixels.ndim == 3 and pixels.shape[2] >= 3 and pixels.dtype == np.uint8:
        blue, green, red = (pixels[:, :, i].astype(np.int32) for i in range(3))
        return red + 256 * green + 65536 * blue
    raise SequenceProblem(
        path,
        f"has shape {pixels.shape} of {pixels.dtype}, not a label map",
        "save ids as one-channel PNG or as 8-bit RGB PNG",
    )
