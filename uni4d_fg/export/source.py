"""A finished run, opened for reading: each part is read when it is first asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path

from uni4d_fg.arrays import Float32Array
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.errors import InputError
from uni4d_fg.reconstruction.depth_store import read_depth
from uni4d_fg.reconstruction.io import load_reconstruction
from uni4d_fg.reconstruction.labels_io import load_labels
from uni4d_fg.reconstruction.model import Reconstruction
from uni4d_fg.reconstruction.run_folder import RunFolder
from uni4d_fg.sequence.model import FrameSource, Sequence
from uni4d_fg.tracks.model import LabelledTracks


class RunSource:
    """What a run left, and the sequence it was made from.

    Args:
        root: The run folder.
        open_sequence: Opens the sequence of the run; called once, when images or masks are first asked for.

    Attributes:
        folder: The files of the run.

    Raises:
        InputError: On construction, if ``root`` is not the folder of a finished run; on access, if a file is
            missing or damaged, or the sequence does not fit the run.
    """

    def __init__(self, root: Path, open_sequence: Callable[[], Sequence] | None = None) -> None:
        self.folder = RunFolder(root)
        self._open_sequence = open_sequence
        if not root.is_dir():
            raise InputError(f"{root}: no such folder; give the folder of a run")
        begun = self.folder.config.is_file() or (root / "stages").is_dir()
        finished = self.folder.reconstruction.is_file() and self.folder.summary.is_file()
        if begun and not finished:
            raise InputError(f"{root}: the run is not finished; finish it with --resume")
        if not finished:
            raise InputError(f"{root}: is not a run, it has no {self.folder.summary.name}; give the folder of a run")

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Cameras, landmarks, trajectories."""
        return load_reconstruction(self.folder.reconstruction)

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return self.reconstruction.num_frames

    @cached_property
    def config(self) -> Config:
        """The configuration of the run."""
        return load_config(self.folder.config)

    @cached_property
    def labels(self) -> LabelledTracks | None:
        """The labelled tracks; None for a run that kept none (``stream``)."""
        return load_labels(self.folder.labels) if self.folder.labels.exists() else None

    @cached_property
    def depth(self) -> FrameSource[Float32Array] | None:
        """Dense depth (H, W) per frame, metres, NaN where missing; None for a run without (``stream``)."""
        if not self.folder.depth.exists():
            return None
        maps = read_depth(self.folder.depth)
        expected = (self.num_frames, *self.reconstruction.image_size)
        if maps.array.shape != expected:
            raise InputError(f"{self.folder.depth}: has shape {maps.array.shape}, but the run has {expected}")
        return maps

    def dense_depth(self, purpose: str) -> FrameSource[Float32Array]:
        """Return the dense depth, which ``purpose`` cannot do without. Raises InputError if there is none."""
        if self.depth is None:
            raise InputError(f"{self.folder.depth}: no such file; {purpose} needs dense depth, which `stream` lacks")
        return self.depth

    @cached_property
    def sequence(self) -> Sequence:
        """The sequence of the run, checked against it."""
        if self._open_sequence is None:
            raise InputError(f"{self.folder.root}: the images of the run are needed; give its sequence")
        try:
            sequence = self._open_sequence()
        except InputError as error:
            raise InputError(
                f"{self.folder.root}: the images of its sequence are needed ({error}); "
                "if it was moved, give its folder with --sequence"
            ) from error
        found = (sequence.num_frames, *sequence.image_size)
        expected = (self.num_frames, *self.reconstruction.image_size)
        if found != expected:
            raise InputError(
                f"{sequence.root or sequence.name}: has {found[0]} frames of {found[2]} x {found[1]} px, but the run "
                f"{self.folder.root} has {expected[0]} of {expected[2]} x {expected[1]} px; give the sequence that it "
                "was made from with --sequence"
            )
        return sequence

    @cached_property
    def frame_names(self) -> tuple[str, ...]:
        """T names for files of frames, in an order that sorting keeps: the sequence's own, else numbers."""
        names = self.sequence.frame_names
        plain = all(name.isprintable() and Path(name).name == name and name[:1] != "." for name in names)
        # Compared with the suffix on, which can change the order of names of which one begins another.
        ordered = all(
            sorted({name + suffix for name in names}) == [name + suffix for name in names]
            for suffix in (".jpg", ".png", ".png.png")
        )
        # COLMAP's text format separates by blanks.
        if plain and ordered and len(names) == self.num_frames and not any(" " in name for name in names):
            return names
        return tuple(f"{frame:05d}" for frame in range(self.num_frames))
