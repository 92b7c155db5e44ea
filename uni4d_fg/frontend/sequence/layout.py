"""Which file of a folder plays which part; the two layouts differ in nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypedDict

from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of
from uni4d_fg.reading import check_regular, is_present, list_folder

LayoutName = Literal["native", "uni4d"]
Layout = Literal["auto", "native", "uni4d"]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
OTHER_IMAGE_SUFFIXES = (".tif", ".tiff", ".bmp", ".webp", ".gif", ".heic", ".heif", ".avif", ".ppm", ".pgm", ".exr")
"""Images that are not read, and are named as such."""
DEPTH_SUFFIXES = (".png", ".npy")
MASK_SUFFIXES = (".png", ".npy")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")
VIDEO_STEMS = ("video", "rgb")
VIDEO_NAMES = tuple(f"{stem}{suffix}" for suffix in VIDEO_SUFFIXES for stem in VIDEO_STEMS)


class LayoutOptions(TypedDict, total=False):
    """Which files of a folder to take where there is a choice; all are optional keyword arguments."""

    depth: str | None
    """Name of the depth cue; None takes ``depth_cue`` (native) or the only candidate (Uni4D)."""
    masks: str | None
    """Mask folder (Uni4D's layout only)."""
    tracks: str | None
    """Track folder (Uni4D's layout only)."""
    depth_gt_scale: float
    """Units per meter of PNGs in ``depth_gt/`` (Uni4D's layout only; native is millimeters). 1000 by default."""
    known_intrinsics: bool
    """Take ``K.npy`` instead of the estimate (Uni4D's layout; native always does). False by default."""


@dataclass(frozen=True)
class SequenceFiles:
    """The files of one sequence; None where an optional one is absent."""

    root: Path
    layout: LayoutName
    images: Path | None
    """Folder of images, or a video file."""
    depth: Path | None = None
    """Folder of depth maps, or one ``.npy`` file."""
    depth_note: Path | None = None
    """Says whether depth is in meters, which it is where this is absent."""
    masks: Path | None = None
    intrinsics: Path | None = None
    tracks: Path | None = None
    timestamps: Path | None = None
    initial_poses: Path | None = None
    true_poses: Path | None = None
    true_depth: Path | None = None
    true_depth_units_per_meter: float = 1000.0
    true_masks: Path | None = None
    true_intrinsics: Path | None = None
    ground_truth: Path | None = None
    problems: tuple[SequenceProblem, ...] = ()
    """What could not be decided, or is absent though asked for."""
    no_depth: SequenceProblem | None = None
    """Said to those who cannot do without depth, where there is none."""


def check_root(root: Path) -> None:
    """Raise InputError unless ``root`` is an existing folder."""
    if not is_present(root):
        raise SequenceProblem(root, "no such folder", "check the path")
    if not root.is_dir():
        raise SequenceProblem(root, "is a file", "give the folder that holds the sequence")


def existing(path: Path) -> Path | None:
    """Return ``path`` if it exists, else None. Raises InputError for a link that leads nowhere."""
    return path if is_present(path) else None


def subfolders(root: Path) -> list[Path]:
    """Return the visible folders in ``root``, sorted by name."""
    return [p for p in list_folder(root) if p.is_dir() and not p.name.startswith(".")]


def find_images(root: Path) -> Path | None:
    """Return where the frames of a sequence folder are; None when it has none.

    That is ``rgb/``, or a video file of one of the names, or the folder itself if it holds image files.
    """
    folder = root / "rgb"
    if is_present(folder) and folder.is_dir():
        return folder
    video = next((root / name for name in VIDEO_NAMES if is_present(root / name)), None)
    if video is not None:
        check_regular(video, "a video file")
        return video
    found = any(is_visible_file(p) and p.suffix.lower() in IMAGE_SUFFIXES for p in list_folder(root))
    return root if found else None


def is_visible_file(path: Path) -> bool:
    """Tell whether ``path`` is something else than a folder whose name does not begin with a dot.

    Whether it can be read as a file is found out when it is: a pipe, or a link to nothing, is not passed over.
    """
    return not path.name.startswith(".") and not path.is_dir()


def not_read_images(root: Path) -> list[str]:
    """Return the endings of the images in a folder that are not read, sorted; empty if there are none."""
    found = {p.suffix.lower() for p in list_folder(root) if is_visible_file(p)}
    return sorted(found & set(OTHER_IMAGE_SUFFIXES))


def missing_images(root: Path) -> SequenceProblem:
    """Return the problem of a folder without frames."""
    return SequenceProblem(
        root,
        "has no rgb/ folder and no video",
        "put the frames into rgb/, or a video.mp4 (.mov, .mkv, .avi, .webm) here",
    )


def list_frames(folder: Path, suffixes: Iterable[str]) -> tuple[Path, ...]:
    """Return the files of a folder with one of the suffixes (any case), sorted by name as plain text.

    Raises:
        InputError: If there is none.
    """
    accepted = tuple(suffixes)
    if not folder.is_dir():
        raise SequenceProblem(folder, "is not a folder", f"make it a folder of {', '.join(accepted)} files")
    names = [p.name for p in list_folder(folder) if is_visible_file(p)]
    frames = tuple(folder / name for name in names if Path(name).suffix.lower() in accepted)
    if not frames:
        found = f"it holds {some_of(names, 3)}" if names else "it is empty"
        raise SequenceProblem(folder, f"has no {', '.join(accepted)} file ({found})", "put one file per frame there")
    return frames


def frame_numbers(stems: Iterable[str]) -> list[int] | None:
    """Return the number that ends each stem ("frame_0012" -> 12), or None if one ends in no number."""
    matches = [re.search(r"(\d+)$", stem) for stem in stems]
    numbers = [int(match.group(1)) for match in matches if match is not None]
    return numbers if len(numbers) == len(matches) else None
