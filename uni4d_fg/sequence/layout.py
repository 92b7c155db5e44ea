"""Which file of a folder plays which part; the two layouts differ in nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from uni4d_fg.sequence.problems import SequenceProblem, some_of

LayoutName = Literal["native", "uni4d"]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".png", ".npy")
MASK_SUFFIXES = (".png", ".npy")
VIDEO_NAMES = ("video.mp4", "rgb.mp4")


@dataclass(frozen=True)
class SequenceFiles:
    """The files of one sequence; None where an optional one is absent."""

    root: Path
    layout: LayoutName
    images: Path | None
    """Folder of images, or a video file."""
    depth: Path | None
    """Folder of depth maps, or one ``.npy`` file."""
    masks: Path | None = None
    intrinsics: Path | None = None
    tracks: Path | None = None
    timestamps: Path | None = None
    initial_poses: Path | None = None
    true_poses: Path | None = None
    true_depth: Path | None = None
    true_depth_units_per_metre: float = 1000.0
    true_intrinsics: Path | None = None
    ground_truth: Path | None = None
    problems: tuple[SequenceProblem, ...] = ()
    """What could not be decided or is absent though needed."""


def check_root(root: Path) -> None:
    """Raise InputError unless ``root`` is an existing folder."""
    if not root.exists():
        raise SequenceProblem(root, "no such folder", "check the path")
    if not root.is_dir():
        raise SequenceProblem(root, "is a file", "give the folder that holds the sequence")


def existing(path: Path) -> Path | None:
    """Return ``path`` if it exists, else None."""
    return path if path.exists() else None


def subfolders(root: Path) -> list[Path]:
    """Return the visible folders in ``root``, sorted by name."""
    return sorted(p for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))


def find_images(root: Path) -> Path | None:
    """Return ``rgb/`` or, without it, the video file of a sequence folder; None when there is neither."""
    folder = root / "rgb"
    if folder.is_dir():
        return folder
    return next((root / name for name in VIDEO_NAMES if (root / name).is_file()), None)


def missing_images(root: Path) -> SequenceProblem:
    """Return the problem of a folder without frames."""
    return SequenceProblem(
        root,
        "has no rgb/ folder and no video",
        f"put the frames into rgb/, or a {' or '.join(VIDEO_NAMES)} here",
    )


def list_frames(folder: Path, suffixes: Iterable[str]) -> tuple[Path, ...]:
    """Return the files of a folder with one of the suffixes (any case), sorted by name as plain text.

    Raises:
        InputError: If there is none.
    """
    accepted = tuple(suffixes)
    if not folder.is_dir():
        raise SequenceProblem(folder, "is not a folder", f"make it a folder of {', '.join(accepted)} files")
    names = sorted(p.name for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
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
