"""Camera intrinsics from 3 x 3 matrices, and what a zoom must be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray
from uni4d_fg.files import load_npy
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.geometry.camera import intrinsics_matrix

MAX_VARIATION = 0.01
"""Per-frame matrices must agree to this part of the focal length (and of the image size, for the center)."""
MAX_SKEW = 1e-3
"""Largest skew, as a part of the focal length, that is taken for zero."""


MIN_FOCAL = 0.1
"""Of the longer image side: an equidistant fisheye that sees all around has 0.16, what is in mm or normalized mostly
less."""
CHECK_SIZE = "check that they were made for images of this size"


class VaryingIntrinsics(SequenceProblem):
    """The intrinsics change along the video (zoom), which one shared camera cannot express."""


def guess_intrinsics(size: tuple[int, int]) -> FloatArray:
    """Return (4,) fx, fy, cx, cy, px: focal length of the longer side, principal point in the center."""
    height, width = size
    focal = float(max(size))
    return np.array([focal, focal, (width - 1) / 2, (height - 1) / 2])


def check_zoom(zoom: FloatArray | None, num_frames: int, where: Path | str) -> None:
    """Check the focal length of each frame over the longest, if there is one.

    Raises:
        SequenceProblem: If it is not one number above 0 and at most 1 per frame.
    """
    if zoom is not None and not (zoom.shape == (num_frames,) and (zoom > 0.0).all() and (zoom <= 1.0).all()):
        raise SequenceProblem(
            where, f"has a zoom that is not {num_frames} numbers above 0 and at most 1",
            "write the focal length of each frame over the longest, or null",
        )  # fmt: skip


def load_intrinsics(path: Path, num_frames: int, size: tuple[int, int]) -> FloatArray:
    """Read the shared intrinsics of a video from a ``.npy`` file, see :func:`shared_intrinsics`. Raises the same."""
    return shared_intrinsics(load_npy(path, memory_map=True), path, num_frames, size)


def shared_intrinsics(values: npt.NDArray[Any], path: Path, num_frames: int, size: tuple[int, int]) -> FloatArray:
    """Return the shared intrinsics of a video.

    Args:
        values: One (3, 3) matrix, (T, 3, 3), whose mean is taken, or (4,) fx, fy, cx, cy, px.
        path: The file they are from.
        num_frames: T.
        size: (height, width), px.

    Returns:
        (4,) fx, fy, cx, cy, px.

    Raises:
        VaryingIntrinsics: If the frames' matrices differ by more than 1 %.
        InputError: If they are not pinhole matrices without skew.
    """
    if values.shape == (4,):
        values = intrinsics_matrix(values)
    if values.ndim not in (2, 3) or values.shape[-2:] != (3, 3) or values.size == 0:
        raise SequenceProblem(
            path, f"has shape {values.shape}", "save one (3, 3) matrix, (T, 3, 3), or (4,) fx, fy, cx, cy"
        )
    if values.size // 9 not in (1, num_frames):
        raise SequenceProblem(
            path,
            f"has {values.size // 9} matrices for {num_frames} frames",
            "save one (3, 3) matrix, or one per frame",
        )
    matrices = np.array(values, dtype=np.float64).reshape(-1, 3, 3)
    if not np.isfinite(matrices).all():
        raise SequenceProblem(path, "has NaN or infinite entries", "save the calibration again")
    focal = matrices[:, (0, 1), (0, 1)]
    if (focal <= 0).any():
        raise SequenceProblem(
            path, f"has a focal length of {focal.min():g} px", "save positive focal lengths in pixels"
        )
    below = matrices[:, (1, 2, 2, 2), (0, 0, 1, 2)] - np.array([0.0, 0.0, 0.0, 1.0])
    if np.abs(below).max() > 1e-6:
        raise SequenceProblem(path, "is not a pinhole matrix", "save [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels")
    skew = np.abs(matrices[:, 0, 1]).max()
    if skew > MAX_SKEW * focal.min():
        raise SequenceProblem(path, f"has a skew of {skew:g} px", "rectify the images; skew is not modeled")
    per_frame = np.concatenate((focal, matrices[:, :2, 2]), axis=1)
    mean: FloatArray = per_frame.mean(axis=0)
    variation = np.abs(per_frame - mean) / np.array([mean[0], mean[1], max(size), max(size)])
    if variation.max() > MAX_VARIATION:
        frame = int(variation.max(axis=1).argmax())
        raise VaryingIntrinsics(
            path,
            f"changes along the video (frame {frame} is {100 * variation.max():.1f} % from the mean)",
            "split the video where the zoom changes; one camera is shared by all frames",
        )
    return mean


def load_given_intrinsics(path: Path, num_frames: int, size: tuple[int, int]) -> FloatArray:
    """Read intrinsics that a solve starts from; arguments and result as in :func:`load_intrinsics`.

    Raises:
        VaryingIntrinsics: If the frames' matrices differ by more than 1 %.
        InputError: As :func:`load_intrinsics` and :func:`check_intrinsics`.
    """
    intrinsics = load_intrinsics(path, num_frames, size)
    check_intrinsics(intrinsics, size, path)
    return intrinsics


def check_intrinsics(intrinsics: FloatArray, size: tuple[int, int], where: Path | str) -> None:
    """Check that (4,) intrinsics, px, can be those of a camera with images of ``size`` (height, width), px.

    Raises:
        InputError: If a focal length is below a tenth of the longer image side, or the principal point lies outside the
            image.
    """
    fault = _impossible(intrinsics, size)
    if fault is not None:
        raise SequenceProblem(where, *fault)


def _impossible(intrinsics: FloatArray, size: tuple[int, int]) -> tuple[str, str] | None:
    """Return why no camera with images of ``size`` (height, width) has (4,) intrinsics, and the remedy, or None."""
    shortest = float(intrinsics[:2].min())
    cx, cy = (float(v) for v in intrinsics[2:])
    height, width = size
    if shortest < MIN_FOCAL * max(size):
        return (
            f"focal length {shortest:g} px is that of no camera with images of {width} x {height} px: it seems to be "
            "in mm, or normalized",
            "give fx, fy, cx, cy in pixels: mm times the image width over the sensor width, normalized ones times the "
            "image width (fx, cx) and height (fy, cy)",
        )
    if not (-0.5 < cx < width - 0.5 and -0.5 < cy < height - 0.5):
        return (
            f"principal point ({cx:.1f}, {cy:.1f}) lies outside the image of {width} x {height} px",
            "give the calibration of images of this size: scale fx, fy, cx and cy as the images were scaled",
        )
    return None


def given_doubts(intrinsics: FloatArray, size: tuple[int, int]) -> list[str]:
    """Return a sentence if given intrinsics (4,), px, are odd for images of ``size`` (height, width)."""
    odd = implausible(intrinsics, size)
    return [] if odd is None else [f"the given intrinsics are odd: {odd}; {CHECK_SIZE}"]


def unusual_focal(
    focal_px: float, size: tuple[int, int], usual: tuple[float, float], remedy: str = "give K.npy if it is known"
) -> list[str]:
    """Return a sentence if a focal length that was found is none that cameras have.

    Args:
        focal_px: What was found.
        size: (height, width) of the images, px.
        usual: Range of focal lengths that cameras have, as parts of the longer image side.
        remedy: What to do about another one.
    """
    part = focal_px / max(size)
    if usual[0] <= part <= usual[1]:
        return []
    return [
        f"the focal length found ({focal_px:.0f} px, {part:.2f} of the longer image side) is unusual: moving things "
        f"without a mask, or motion from which it cannot be told; {remedy}"
    ]


def implausible(intrinsics: FloatArray, size: tuple[int, int]) -> str | None:
    """Say what is odd about (4,) intrinsics for images of ``size`` (height, width), or return None."""
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    height, width = size
    fault = _impossible(intrinsics, size)
    if fault is not None:
        return fault[0]
    if abs(cx - (width - 1) / 2) > 0.25 * width or abs(cy - (height - 1) / 2) > 0.25 * height:
        return f"principal point ({cx:.1f}, {cy:.1f}) is far from the center of the {width} x {height} px image"
    if not 0.2 * width < fx < 10 * width:
        return f"focal length {fx:.1f} px is unusual for an image {width} px wide"
    if not 0.8 < fx / fy < 1.25:
        return f"focal lengths {fx:.1f} and {fy:.1f} px differ by more than 25 %"
    return None
