"""What every dataset is: named videos in a folder, opened one by one, and what to say when something is missing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.frontend.sequence.decode import read_depth
from uni4d_fg.frontend.sequence.frames import ImageFolder, LazyFrames
from uni4d_fg.frontend.sequence.layout import IMAGE_SUFFIXES, list_frames, subfolders
from uni4d_fg.frontend.sequence.model import FrameSource, GroundTruth, Video
from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of
from uni4d_fg.frontend.sequence.selection import MIN_FRAMES, FrameSelection
from uni4d_fg.reading import is_present

Split: TypeAlias = "tuple[str, ...] | None"
"""Names of videos, in the order of tables; None for all that are there."""


@dataclass(frozen=True)
class DatasetCard:
    """What a table says about a dataset."""

    name: str
    """By which it is chosen."""
    title: str
    truth: tuple[str, ...]
    """What is known: of 'poses', 'depth', 'masks', 'tracks', 'intrinsics'."""
    convention: str
    """Which frames and poses are taken, and after whom."""
    urls: tuple[str, ...]
    """Where to get it."""
    splits: Mapping[str, Split]
    default_split: str
    max_depth_m: float | None
    """Cap of true depth in the field's tables, m."""
    selection: FrameSelection = field(default_factory=FrameSelection)
    """Which of the frames in the dataset's folders are used."""
    is_made: bool = False
    """Whether its videos are made when they are first opened, so that any folder will do."""


class Dataset(ABC):
    """A dataset in the folder layout of its makers.

    Attributes:
        card: What it is.
    """

    card: DatasetCard

    @abstractmethod
    def found(self, root: Path) -> tuple[str, ...]:
        """Return the names of the videos that are there, sorted. Raises InputError if there is no such folder."""

    @abstractmethod
    def open(self, root: Path, video: str) -> Video:
        """Open one video with its truth; frames, depth and masks are decoded only when they are used.

        Its intrinsics are in the truth alone: whether a method is told them is for whoever runs it to say.

        Raises:
            InputError: If something is missing or damaged; the message says what, and where to get it.
        """

    def size(self, root: Path, video: str) -> tuple[int, tuple[int, int]]:
        """Return the number of frames of a video and its (height, width), px. Raises as :meth:`open`."""
        found = self.open(root, video)
        return found.num_frames, found.image_size

    def notes(self, root: Path, video: str) -> tuple[str, ...]:
        """Return what a reader of the video's scores should know."""
        return ()

    def videos(self, root: Path, split: str | None = None) -> tuple[str, ...]:
        """Return the names of the videos of a split, whether they are there or not.

        Raises:
            InputError: If there is no such split, no such folder, or none of the videos is there.
        """
        card = self.card
        chosen = split or card.default_split
        if chosen not in card.splits:
            raise SequenceProblem(card.name, f"has no split {chosen!r}", f"choose one of {', '.join(card.splits)}")
        there, names = self.found(root), card.splits[chosen]
        wanted = there if names is None else names
        if not set(there) & set(wanted):
            seen = f"found {some_of(there)}" if there else "nothing is there in its layout"
            raise SequenceProblem(root, f"holds no video of {card.title} ({seen})", self.remedy(root))
        return wanted

    def remedy(self, root: Path) -> str:
        """Return where to get the dataset and what to do with it."""
        return f"download {' and '.join(self.card.urls)} and unpack into {root}"

    def need_folder(self, path: Path, root: Path) -> Path:
        """Return ``path``. Raises InputError with :meth:`remedy` unless it is a folder."""
        if not path.is_dir():
            raise SequenceProblem(path, "no such folder", self.remedy(root))
        return path

    def need_file(self, path: Path, root: Path) -> Path:
        """Return ``path``. Raises InputError with :meth:`remedy` unless something is there."""
        if not is_present(path):
            raise SequenceProblem(path, "no such file", self.remedy(root))
        return path


def names_of_folders(folder: Path, prefix: str = "") -> tuple[str, ...]:
    """Return the names of the folders in ``folder`` that begin with ``prefix``, sorted; none if it is not there."""
    return tuple(path.name for path in subfolders(folder) if path.name.startswith(prefix)) if folder.is_dir() else ()


def selected(paths: tuple[Path, ...], selection: FrameSelection) -> tuple[Path, ...]:
    """Return the selected of the files of a video."""
    return tuple(paths[int(i)] for i in selection.indices(len(paths)))


def frame_number(path: Path) -> int:
    """Return the number at the end of a file's name. Raises InputError if there is none."""
    digits = path.stem[len(path.stem.rstrip("0123456789")) :]
    if not digits:
        raise SequenceProblem(path, "has no frame number in its name", "name it as the dataset does")
    return int(digits)


def images_of(folder: Path, suffixes: Iterable[str] = IMAGE_SUFFIXES) -> tuple[Path, ...]:
    """Return the image files of a folder, by name. Raises InputError if there is none."""
    return list_frames(folder, suffixes)


def numbers_without_gap(paths: tuple[Path, ...]) -> None:
    """Raise InputError if a frame is missing between the first and the last."""
    numbers = sorted(frame_number(path) for path in paths)
    for before, after in pairwise(numbers):
        if after > before + 1:
            absent = f"{before + 1}" if after == before + 2 else f"{before + 1} to {after - 1}"
            raise SequenceProblem(
                paths[0].parent, f"lacks frame(s) {absent} between others", "unpack the archive again"
            )


def images_of_truth(paths: tuple[Path, ...], truth: Path, suffix: str) -> None:
    """Raise InputError if a frame at either end has truth in a folder, ``NAME.suffix``, but no image."""
    absent = sorted({path.stem for path in truth.glob(f"*{suffix}")} - {path.stem for path in paths})
    if absent:
        raise SequenceProblem(
            paths[0].parent, f"lacks {some_of(absent)}, of which there is truth in {truth}", "unpack the archive again"
        )


def make_video(name: str, root: Path, paths: tuple[Path, ...], timestamps: FloatArray, truth: GroundTruth) -> Video:
    """Return a video of image files without cues; the first image is decoded.

    Raises:
        InputError: If there are too few frames, or times do not increase.
    """
    if len(paths) < MIN_FRAMES:
        raise SequenceProblem(root, f"has {len(paths)} frame(s) to use", f"give at least {MIN_FRAMES}")
    with np.errstate(invalid="ignore"):  # of infinite times
        stuck = np.flatnonzero(~(np.diff(timestamps) > 0) | ~np.isfinite(timestamps[1:]))
    if stuck.size:
        raise SequenceProblem(root, f"times do not increase after frame {stuck[0]}", "unpack the archive again")
    images = ImageFolder(paths)
    return Video(
        name=name, images=images, image_size=images.size, timestamps=timestamps, root=root,
        frame_names=tuple(path.stem for path in paths), ground_truth=truth,
    )  # fmt: skip


class PngDepth(LazyFrames[Float32Array]):
    """True depth of some frames of a video, from 16-bit PNGs; NaN everywhere in the others.

    Args:
        paths: T files; None for a frame without.
        size: (height, width) of the images, px.
        units_per_meter: Divisor that turns values into meters.
    """

    def __init__(self, paths: tuple[Path | None, ...], size: tuple[int, int], units_per_meter: float) -> None:
        self.paths, self.size, self.units_per_meter = paths, size, units_per_meter

    def __len__(self) -> int:
        return len(self.paths)

    def where(self, frame: int) -> str:
        """Return the file of a frame."""
        return str(self.paths[frame])

    def _read(self, frame: int) -> Float32Array:
        path = self.paths[frame]
        if path is None:
            return np.full(self.size, np.nan, dtype=np.float32)
        depth = read_depth(path, self.units_per_meter)
        if depth.shape != self.size:
            raise SequenceProblem(
                path,
                f"is {depth.shape[1]} x {depth.shape[0]} px, but the first image is {self.size[1]} x {self.size[0]} px",
                "unpack the archive again",
            )
        return depth


def first_read(frames: FrameSource[Float32Array]) -> FrameSource[Float32Array]:
    """Return ``frames`` after its first frame was read, so that what is wrong with all of them is said at once."""
    frames[0]
    return frames
