"""Images, masks and depth maps of a run as files for other programs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence as SequenceOf
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.errors import OutputError
from uni4d_fg.frontend.sequence.frames import ImageFolder
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.results.run import Run

JPEG_QUALITY = 95
MILLIMETERS = 1000.0
MAX_PNG_DEPTH = 65.534
"""Meters above which 16-bit millimeters do not reach (65535 is read as missing by many programs)."""

_COPIED_SUFFIXES = (".png", ".jpg", ".jpeg")


def encode(image: npt.NDArray[Any], suffix: str, path: Path) -> bytes:
    """Return an image (RGB, RGBA, or one channel) as the bytes of a ``.png`` or ``.jpg`` file.

    Raises:
        OutputError: If it cannot be encoded; ``path`` is named.
    """
    # OpenCV's order: blue first, alpha last.
    pixels = np.ascontiguousarray(image[:, :, [2, 1, 0, 3][: image.shape[2]]]) if image.ndim == 3 else image
    flags = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if suffix == ".jpg" else []
    encoded, data = cv2.imencode(suffix, pixels, flags)
    if not encoded:
        raise OutputError(f"cannot write {path}: encoding a {image.shape} image failed; check its size")
    return data.tobytes()


def frame_names(run: Run) -> tuple[str, ...]:
    """Return T names for files of frames, in an order that sorting keeps: the sequence's own, else numbers.

    Raises:
        InputError: If the sequence is not at hand.
    """
    names = run.need_sequence().frame_names
    plain = all(name.isprintable() and Path(name).name == name and name[:1] != "." for name in names)
    # Compared with the suffix on, which can change the order of names of which one begins another.
    ordered = all(
        sorted({name + suffix for name in names}) == [name + suffix for name in names]
        for suffix in (".jpg", ".png", ".png.png")
    )
    # COLMAP's text format separates by blanks.
    if plain and ordered and len(names) == run.num_frames and not any(" " in name for name in names):
        return names
    return tuple(f"{frame:05d}" for frame in range(run.num_frames))


def write_images(job: ExportJob, folder: Path) -> list[str]:
    """Write every frame into ``folder``: files of the sequence are copied, frames of a video become JPEG.

    A file is copied only if other programs see the same pixels in it as this one does: 8-bit color.

    Returns:
        The T file names, in frame order; sorting keeps it.
    """
    run = job.run
    folder.mkdir(parents=True)
    images = run.need_sequence().images
    paths = images.paths if isinstance(images, ImageFolder) else ()
    # One suffix for all: a mixture could sort differently from the frames.
    suffixes = {path.suffix for path in paths}
    if len(suffixes) == 1 and min(suffixes).lower() in _COPIED_SUFFIXES:
        suffix = suffixes.pop()
    else:
        suffix = ".png" if paths else ".jpg"
    names = [f"{stem}{suffix}" for stem in frame_names(run)]
    for frame, name in enumerate(names):
        image, target = images[frame], folder / name
        if paths and paths[frame].suffix == suffix and _is_plain_color(paths[frame], image):
            shutil.copyfile(paths[frame], target)
        else:
            target.write_bytes(encode(image, ".png" if suffix.lower() == ".png" else ".jpg", target))
        job.advance(frame + 1)
    return names


def _is_plain_color(path: Path, image: ImageArray) -> bool:
    """Tell whether a reader that heeds orientation tags finds the same 8-bit RGB pixels in the file."""
    data = np.frombuffer(path.read_bytes(), np.uint8)
    raw, upright = cv2.imdecode(data, cv2.IMREAD_UNCHANGED), cv2.imdecode(data, cv2.IMREAD_COLOR)
    if raw is None or upright is None or raw.shape != image.shape or raw.dtype != np.uint8:
        return False
    return np.array_equal(upright[:, :, ::-1], image)


def write_masks(job: ExportJob, folder: Path, names: list[str]) -> int:
    """Write one PNG per frame, 255 where static and 0 where something moves; nothing if nothing ever moves.

    Args:
        job: The export.
        folder: Where to write; made if anything is written.
        names: File names, T.

    Returns:
        The number of masks written: T or 0.
    """
    masks = job.run.need_sequence().masks
    if not any(bool((mask > 0).any()) for mask in masks):
        return 0
    folder.mkdir(parents=True)
    for name, mask in zip(names, masks, strict=True):
        path = folder / name
        path.write_bytes(encode(np.where(mask > 0, 0, 255).astype(np.uint8), ".png", path))
        job.check()
    return len(names)


def write_confidence(job: ExportJob, folder: Path, stems: SequenceOf[str]) -> None:
    """Write how sure static depth is, one 8-bit PNG per frame; nothing if the run does not know.

    Args:
        job: The export.
        folder: Where to write; made if anything is written.
        stems: File names without suffix, T.
    """
    confidence = job.run.confidence
    if confidence is None:
        return
    folder.mkdir(parents=True)
    for stem, sure in zip(stems, confidence, strict=True):
        path = folder / f"{stem}.png"
        path.write_bytes(encode(np.rint(255 * sure).astype(np.uint8), ".png", path))
        job.check()
    job.facts.append(
        f"{folder.name}/: 8-bit PNG, 255 times the probability that static depth is right to 3 %, 0 where it moves"
    )


def depth_png(depth: Float32Array, path: Path) -> bytes:
    """Return a depth map (H, W), meters, as a 16-bit PNG in millimeters; 0 where missing or beyond 65.5 m."""
    with np.errstate(invalid="ignore"):
        known = np.isfinite(depth) & (depth > 0.0) & (depth <= MAX_PNG_DEPTH)
    millimeters = np.rint(np.where(known, depth, 0.0).astype(np.float64) * MILLIMETERS)
    return encode(millimeters.astype(np.uint16), ".png", path)
