"""A finished run as it is shown: what must be there, and what may be missing and is then left out."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from uni4d_fg.arrays import Float32Array
from uni4d_fg.errors import InputError
from uni4d_fg.reconstruction.depth_store import read_depth
from uni4d_fg.reconstruction.io import load_reconstruction
from uni4d_fg.reconstruction.labels_io import load_labels
from uni4d_fg.reconstruction.model import Reconstruction
from uni4d_fg.reconstruction.run_folder import RunFolder
from uni4d_fg.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.tracks.model import LabelledTracks

ValueT = TypeVar("ValueT")

SequenceReader: TypeAlias = Callable[[], "Sequence | Video"]


@dataclass(frozen=True)
class OpenedRun:
    """The results of a run. What could not be read is None, and ``notes`` says why."""

    folder: RunFolder
    reconstruction: Reconstruction
    summary: dict[str, Any]
    """Content of ``summary.json``."""
    labelled: LabelledTracks | None
    """The tracks used; absent in runs of ``stream``."""
    depth: FrameSource[Float32Array] | None
    """T fused maps (H, W), metres; absent in runs of ``stream``."""
    sequence: Sequence | Video | None
    """What was reconstructed, if it is still where it was."""
    notes: tuple[str, ...]
    """One sentence for everything that is missing."""

    @property
    def name(self) -> str:
        """Name of the sequence."""
        sequence = self.summary.get("sequence")
        name = sequence.get("name") if isinstance(sequence, dict) else None
        return str(name or self.folder.root.resolve().name)

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres, as far as is known; else they are of an unknown unit."""
        cues = self.summary.get("cues")
        return not isinstance(cues, dict) or cues.get("metric") is not False

    @property
    def unit(self) -> str:
        """Unit of lengths."""
        return "m" if self.is_metric else "units"

    @property
    def small_unit(self) -> tuple[float, str]:
        """Factor and unit for small lengths: millimetres where lengths are metres."""
        return (1000.0, "mm") if self.is_metric else (1.0, "units")

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return self.reconstruction.num_frames


def open_run(root: Path, read_sequence: SequenceReader) -> OpenedRun:
    """Open the folder of a finished run.

    Args:
        root: The run's folder.
        read_sequence: Opens the sequence of the run; if that fails, the run is shown without images.

    Raises:
        InputError: If there is no such folder, it holds no run or an unfinished one, or its reconstruction is damaged.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; give the folder of a run")
    folder = RunFolder(root)
    if not (folder.reconstruction.is_file() and folder.summary.is_file()):
        if folder.config.is_file() or (root / "stages").is_dir():
            raise InputError(f"{root}: the run is not finished; continue it with its command line and --resume")
        raise InputError(f"{root}: holds no run; give the folder that `uni4d-fg reconstruct` wrote (--out)")
    reconstruction = load_reconstruction(folder.reconstruction)
    summary = _read_summary(folder.summary)
    notes: list[str] = []

    def part(read: Callable[[], ValueT], lost: str) -> ValueT | None:
        try:
            return read()
        except InputError as error:
            notes.append(f"{lost}: {error}")
            return None

    labelled = part(lambda: _labels(folder, reconstruction), "tracks are not shown")
    depth = part(lambda: _depth(folder, reconstruction), "fused depth is not shown")
    sequence = part(lambda: _sequence(read_sequence, reconstruction), "images are not shown")
    return OpenedRun(folder, reconstruction, summary, labelled, depth, sequence, tuple(notes))


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error}); run the reconstruction again") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: holds no summary of a run; run the reconstruction again")
    return value


def _labels(folder: RunFolder, reconstruction: Reconstruction) -> LabelledTracks:
    labelled = load_labels(folder.labels)
    used = [*reconstruction.landmark_track.tolist(), *reconstruction.dynamic_track.tolist()]
    if labelled.tracks.num_frames != reconstruction.num_frames or max(used, default=0) >= labelled.tracks.num_tracks:
        raise InputError(f"{folder.labels}: is not of this reconstruction")
    return labelled


def _depth(folder: RunFolder, reconstruction: Reconstruction) -> FrameSource[Float32Array]:
    depth = read_depth(folder.depth)
    expected = (reconstruction.num_frames, *reconstruction.image_size)
    if depth.array.shape != expected:
        raise InputError(f"{folder.depth}: has shape {depth.array.shape}, expected {expected}")
    return depth


def _sequence(read_sequence: SequenceReader, reconstruction: Reconstruction) -> Sequence | Video:
    sequence = read_sequence()
    found = (sequence.num_frames, *sequence.image_size)
    expected = (reconstruction.num_frames, *reconstruction.image_size)
    if found != expected:
        raise InputError(
            f"sequence {sequence.name!r} is now {found[0]} frames of {found[2]}x{found[1]} px, the run has "
            f"{expected[0]} of {expected[2]}x{expected[1]}"
        )
    return sequence
