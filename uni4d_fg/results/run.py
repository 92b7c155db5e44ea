"""A finished run, opened for reading: what must be there, and parts that are read when they are first asked for.

A part can be missing or damaged: runs of ``stream`` have no tracks and no dense depth, and sequences are moved away.
There are two ways to ask for one. Its attribute is None then, and :attr:`Run.notes` says why: for showing what there
is. ``need_...`` raises instead: for files that must be whole.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from uni4d_fg.arrays import Float32Array
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.results.confidence_store import read_confidence
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.preview import check_has_cameras, preview
from uni4d_fg.results.run_folder import RunFolder, is_finished
from uni4d_fg.results.summary_file import read_summary
from uni4d_fg.slam.reconstruction import Reconstruction

ValueT = TypeVar("ValueT")

SequenceReader: TypeAlias = Callable[[], "Sequence | Video"]

_PARTS = {"labelled": "tracks are not shown", "depth": "fused depth is not shown", "sequence": "images are not shown"}
IF_MOVED = "if it was moved, give its folder with --sequence"
"""What to do about a sequence that is not where it was."""
_OPTIONAL_PARTS = ("confidence",)
"""Nobody misses them."""


@dataclass(frozen=True)
class _Part(Generic[ValueT]):
    """What was read, or why it could not be."""

    value: ValueT | None
    error: InputError | None

    @classmethod
    def read(cls, reader: Callable[[], ValueT]) -> _Part[ValueT]:
        try:
            return cls(reader(), None)
        except InputError as error:
            return cls(None, error)

    def need(self) -> ValueT:
        if self.value is None:
            raise self.error or InputError("it was left out")
        return self.value


class Run:
    """The results of a run, and the sequence that it was made from.

    Args:
        root: The run's folder.
        read_sequence: Opens the sequence of the run; called once, when it is first asked for.
        unfinished: Take a run that is going on as well, with what its stages have found so far.

    Attributes:
        folder: The files of the run.
        reconstruction: Cameras, landmarks, trajectories.
        summary: Content of ``summary.json``.

    Raises:
        InputError: If there is no such folder, it holds no run or an unfinished one, or its reconstruction or its
            summary is damaged.
    """

    def __init__(self, root: Path, read_sequence: SequenceReader | None = None, *, unfinished: bool = False) -> None:
        self.folder = folder = RunFolder(root)
        self._read_sequence = read_sequence
        finished = is_finished(folder, unfinished=unfinished and read_sequence is not None)
        if not finished and read_sequence is not None:
            self._open_unfinished(read_sequence)
            return
        self.reconstruction: Reconstruction = load_reconstruction(folder.reconstruction)
        self.summary: dict[str, Any] = read_summary(folder.summary)

    def _open_unfinished(self, read_sequence: SequenceReader) -> None:
        check_has_cameras(self.folder.root)
        sequence = read_sequence()
        self._read_sequence = lambda: sequence
        self.reconstruction, stage = preview(self.folder.root, self.folder.labels, sequence)
        said = f"the run is not finished: this is what stage {stage.replace('_', ' ')} found; open it again later"
        self.summary = {"sequence": {"name": sequence.name}, "warnings": [said]}

    def with_parts(self, **parts: Any) -> Run:
        """Return the run with other parts: attributes by name; an InputError stands for a part that is not there."""
        changed = copy.copy(self)
        for name, value in parts.items():
            if name not in (*_PARTS, *_OPTIONAL_PARTS):
                setattr(changed, name, value)
            elif isinstance(value, InputError):
                changed.__dict__[f"_{name}"] = _Part(None, value)
            else:
                changed.__dict__[f"_{name}"] = _Part(value, None)
        return changed

    @property
    def name(self) -> str:
        """Name of the sequence."""
        sequence = self.summary.get("sequence")
        name = sequence.get("name") if isinstance(sequence, dict) else None
        return str(name or self.folder.root.resolve().name)

    @property
    def is_metric(self) -> bool:
        """Whether lengths are meters, as far as is known; else they are of an unknown unit."""
        cues = self.summary.get("cues")
        return not isinstance(cues, dict) or cues.get("metric") is not False

    @property
    def depth_is_unknown(self) -> bool:
        """Whether everything was put at an assumed distance: the camera stays in one place, and no depth was given."""
        fusion = self.summary.get("stages", {}).get("fusion")
        return isinstance(fusion, dict) and fusion.get("depth_is_unknown") is True

    @property
    def unit(self) -> str:
        """Unit of lengths."""
        return "m" if self.is_metric else "units"

    @property
    def small_unit(self) -> tuple[float, str]:
        """Factor and unit for small lengths: millimeters where lengths are meters."""
        return (1000.0, "mm") if self.is_metric else (1.0, "units")

    @property
    def has_times(self) -> bool:
        """Whether timestamps are seconds; those of images that came without times count frames."""
        times = self.reconstruction.timestamps
        return not np.array_equal(times, np.arange(len(times)))

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return self.reconstruction.num_frames

    @cached_property
    def config(self) -> Config:
        """The configuration of the run. Raises ConfigError or InputError if it cannot be read."""
        return load_config(self.folder.config)

    @property
    def labelled(self) -> LabelledTracks | None:
        """The tracks used; absent in runs of ``stream``."""
        return self._labelled.value

    @property
    def depth(self) -> FrameSource[Float32Array] | None:
        """T fused maps (H, W), meters, NaN where missing; absent in runs of ``stream``."""
        return self._depth.value

    @property
    def confidence(self) -> FrameSource[Float32Array] | None:
        """T maps (H, W), the probability that static depth is right to 3 %; absent where it is not known."""
        return self._confidence.value

    @property
    def sequence(self) -> Sequence | Video | None:
        """What was reconstructed, if it is still where it was."""
        return self._sequence.value

    @property
    def notes(self) -> tuple[str, ...]:
        """One sentence for every part that is missing; reads them all."""
        errors = {"labelled": self._labelled.error, "depth": self._depth.error, "sequence": self._sequence.error}
        return tuple(f"{_PARTS[name]}: {error}" for name, error in errors.items() if error is not None)

    def need_labelled(self) -> LabelledTracks:
        """Return the tracks used. Raises InputError if they are missing or damaged."""
        return self._labelled.need()

    def need_depth(self, purpose: str) -> FrameSource[Float32Array]:
        """Return the fused maps, which ``purpose`` cannot do without. Raises InputError if there are none."""
        if self._depth.error is not None:
            raise InputError(f"{purpose} needs dense depth, which `stream` does not make: {self._depth.error}")
        return self._depth.need()

    def need_sequence(self) -> Sequence:
        """Return the sequence with all its cues. Raises InputError if it is not at hand or does not fit the run."""
        if self._sequence.error is not None:
            raise InputError(
                f"{self.folder.root}: the images of its sequence are needed ({self._sequence.error}); {IF_MOVED}"
            ) from self._sequence.error
        sequence = self._sequence.need()
        if not isinstance(sequence, Sequence):
            raise InputError(f"{self.folder.root}: its sequence was opened without its cues")
        return sequence

    @cached_property
    def _labelled(self) -> _Part[LabelledTracks]:
        return _Part.read(self._load_labels)

    @cached_property
    def _depth(self) -> _Part[FrameSource[Float32Array]]:
        return _Part.read(self._load_depth)

    @cached_property
    def _confidence(self) -> _Part[FrameSource[Float32Array]]:
        return _Part.read(self._load_confidence)

    @cached_property
    def _sequence(self) -> _Part[Sequence | Video]:
        return _Part.read(self._load_sequence)

    def _load_labels(self) -> LabelledTracks:
        labelled, result = load_labels(self.folder.labels), self.reconstruction
        used = [*result.landmark_track.tolist(), *result.dynamic_track.tolist()]
        if labelled.tracks.num_frames != result.num_frames or max(used, default=0) >= labelled.tracks.num_tracks:
            raise InputError(f"{self.folder.labels}: is not of this reconstruction")
        return labelled

    def _load_depth(self) -> FrameSource[Float32Array]:
        depth = read_depth(self.folder.depth)
        expected = (self.num_frames, *self.reconstruction.image_size)
        if depth.array.shape != expected:
            raise InputError(f"{self.folder.depth}: has shape {depth.array.shape}, but the run has {expected}")
        return depth

    def _load_confidence(self) -> FrameSource[Float32Array]:
        confidence = read_confidence(self.folder.confidence, self.reconstruction.image_size)
        if len(confidence) != self.num_frames:
            raise InputError(f"{self.folder.confidence}: has {len(confidence)} frames, but the run {self.num_frames}")
        return confidence

    def _load_sequence(self) -> Sequence | Video:
        if self._read_sequence is None:
            raise InputError("its sequence was not given; open the run with Run(folder, read_sequence)")
        sequence = self._read_sequence()
        found = (sequence.num_frames, *sequence.image_size)
        expected = (self.num_frames, *self.reconstruction.image_size)
        if found != expected:
            raise InputError(
                f"{sequence.root or sequence.name}: has {found[0]} frames of {found[2]}x{found[1]} px, but the run has "
                f"{expected[0]} of {expected[2]}x{expected[1]} px"
            )
        return sequence
