"""What the arrays of one frame must be, whoever hands them over: files are read into this form, callers may not be."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray, Int32Array
from uni4d_fg.config.cues import InputConfig
from uni4d_fg.errors import InputError

_MAX_ID = np.iinfo(np.int32).max


def checked_image(image: Any, size: tuple[int, int], where: str, *, gray: bool = False) -> ImageArray:
    """Return an image as an array.

    Args:
        image: (H, W, 3) uint8 RGB; with ``gray`` also (H, W).
        size: (height, width) that it must have, px.
        where: What to call it in messages.
        gray: Whether one channel will do.

    Raises:
        InputError: If it is not of that form.
    """
    array = _array(image, where)
    shapes = [(*size, 3), size] if gray else [(*size, 3)]
    if array.shape not in shapes:
        expected = " or ".join(map(str, shapes))
        raise InputError(f"{where} has shape {array.shape}, but {expected} is expected; the video is {size}")
    if array.dtype != np.uint8:
        raise InputError(f"{where} has dtype {array.dtype}, expected uint8; scale it to 0 to 255")
    return array


def checked_depth(depth: Any, size: tuple[int, int], where: str) -> Float32Array:
    """Return a depth map in meters as a new array of float32 in which all that is not positive and finite is NaN.

    Raises:
        InputError: As :func:`floating_depth`.
    """
    array = floating_depth(depth, size, where)
    with np.errstate(over="ignore", invalid="ignore"):
        cleaned: Float32Array = array.astype(np.float32)
        cleaned[~((cleaned > 0) & np.isfinite(cleaned))] = np.nan
    return cleaned


def usable_depth(depth: npt.NDArray[Any], limits: InputConfig) -> BoolArray:
    """Return which depths, meters, of any shape, are within the limits; outside they are treated as missing."""
    return np.asarray((depth >= limits.min_depth_m) & (depth <= limits.max_depth_m))


def outside_limits(median: float, limits: InputConfig, unit: str, everywhere: str) -> tuple[str, str]:
    """Say that all depth is outside the limits, and what to do.

    Args:
        median: Of the depth, in its unit.
        limits: The limits.
        unit: What to call the unit.
        everywhere: Where it is outside.
    """
    return (
        f"lies outside {limits.min_depth_m:g} to {limits.max_depth_m:g} {unit} {everywhere} (its median is "
        f"{median:.4g}), and depth outside is treated as missing",
        "check the unit: PNGs are in millimeters, .npy and arrays in meters; or set input.min_depth_m and "
        "input.max_depth_m",
    )


def floating_depth(depth: Any, size: tuple[int, int], where: str) -> npt.NDArray[Any]:
    """Return a depth map as it is. Raises InputError if it is not (H, W) floats: whole numbers have no unit."""
    array = _of_size(depth, size, where)
    if array.dtype.kind in "iu":
        raise InputError(f"{where} holds {array.dtype} values of unknown unit; give meters as floats")
    if array.dtype.kind != "f":
        raise InputError(f"{where} has dtype {array.dtype}; give meters as floats")
    return array


def checked_mask(mask: Any, size: tuple[int, int], where: str) -> Int32Array:
    """Return a label map as int32; 0 is static.

    Raises:
        InputError: If it is not (H, W) whole numbers from 0 to 2**31 - 1.
    """
    array = _of_size(mask, size, where)
    if array.dtype.kind not in "biu":
        raise InputError(f"{where} has dtype {array.dtype}; give whole numbers, 0 for what is static")
    if array.dtype != np.int32 and array.size and int(array.max()) > _MAX_ID:
        raise InputError(f"{where} has an id of {int(array.max())}; use ids from 0 to {_MAX_ID}")
    if array.dtype.kind == "i" and array.size and int(array.min()) < 0:
        raise InputError(f"{where} has an id of {int(array.min())}; use ids from 0 to {_MAX_ID}")
    return np.asarray(array, dtype=np.int32)


def _of_size(value: Any, size: tuple[int, int], where: str) -> npt.NDArray[Any]:
    array = _array(value, where)
    if array.shape != tuple(size):
        raise InputError(f"{where} has shape {array.shape}, the video is {size}; bring all to one size")
    return array


def _array(value: Any, where: str) -> npt.NDArray[Any]:
    try:
        array: npt.NDArray[Any] = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{where} is a {type(value).__name__} and no array of numbers; give a NumPy array") from error
    return array
