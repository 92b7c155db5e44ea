"""Guarding run folders, and remembering which video a run was made from."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config

from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cues.manifest import has_manifest, load_cues
from uni4d_fg.cues.plan import CueFiles, CuePlan, plan_cues
from uni4d_fg.errors import ConfigError, InputError, OutputError
from uni4d_fg.files import atomic_write_json
from uni4d_fg.frontend.sequence.assemble import as_sequence, assemble_video
from uni4d_fg.frontend.sequence.layout import Layout, LayoutOptions
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.read import detect_layout, find_files, read_sequence
from uni4d_fg.frontend.sequence.selection import FrameSelection, select_frames
from uni4d_fg.reading import expanded, is_present, read_text, resolved
from uni4d_fg.results.run import IF_MOVED
from uni4d_fg.results.run_contents import COMMAND_LINE, STORED_INPUT, claim_folder
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.results.summary_file import read_summary

DEMO_SEQUENCE = "sequence"
CUE_FOLDER = "cues"

_MADE_MASKS = ("motion", "none")
_SAME_VIDEO = ("root", "layout", "start", "stop", "stride", "max_size")
_MAX_INPUT_BYTES = 1024**2


@dataclass(frozen=True)
class OpenedInput:
    """A video as the command line asked for it, before its cues are made."""

    video: Video
    bare: bool
    """It is frames only: a video file, or images without a depth cue of their own."""


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True)
class SequenceInput:
    """What was asked for on the command line; kept beside a run's results."""

    root: str
    layout: Layout = "auto"
    depth: str | None = None
    masks: str | None = None
    tracks: str | None = None
    depth_gt_scale: float = 1000.0
    known_intrinsics: bool = False
    intrinsics: str | None = None
    start: int = 0
    stop: int | None = None
    stride: int = 1
    max_size: int | None = None
    depth_model: str | None = None
    mask_model: str | None = None
    classes: tuple[str, ...] | None = None
    track_model: str | None = None
    cues: str | None = field(default=None, compare=False)
    """Folder of the cues that were made for it, if any; not written down."""

    @classmethod
    def of(
        cls, root: Path, layout: LayoutChoice, depth: str | None, masks: str | None, tracks: str | None, *,
        depth_gt_scale: float, known_intrinsics: bool, **more: Any,
    ) -> SequenceInput:  # fmt: skip
        """Take over command-line values; paths become absolute.

        Args:
            root: Sequence folder, folder of images, or video file.
            layout: Of a sequence folder.
            depth: Name of a cue of the sequence, or a file or folder beside it.
            masks: The same; or 'motion' or 'none'.
            tracks: The same.
            depth_gt_scale: Units per meter of true depth in PNGs (Uni4D's layout).
            known_intrinsics: Take ``K.npy`` instead of the estimate (Uni4D's layout).
            more: The other fields.
        """
        root = resolved(root)
        more["intrinsics"] = _absolute(root, more.get("intrinsics"))
        return cls(
            str(root), layout.value, _absolute(root, depth), _absolute(root, masks), _absolute(root, tracks),
            depth_gt_scale, known_intrinsics, **more,
        )  # fmt: skip

    def moved_to(self, root: Path) -> SequenceInput:
        """Return the same input at another place; cues that were made for it stay where they are."""
        return replace(self, root=str(root.resolve()))

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments of :func:`read_sequence`."""
        names = ("layout", "depth", "masks", "tracks", "depth_gt_scale", "known_intrinsics")
        return {name: getattr(self, name) for name in names}

    @property
    def selection(self) -> FrameSelection:
        """Frames that are used, and how large. Raises InputError if that cannot be."""
        return FrameSelection(self.start, self.stop, self.stride, self.max_size)

    @property
    def calibration(self) -> Path | None:
        """File of the intrinsics that take the place of the sequence's own, if any."""
        return None if self.intrinsics is None else _beside(Path(self.root), self.intrinsics)

    def open(self) -> OpenedInput:
        """Open the video with the cues that come with it. Raises InputError."""
        root = Path(self.root)
        options, files = self._sources()
        selection = self.selection
        if not files:
            video = open_video(root, selection, self.layout, **options)
            return OpenedInput(video, root.is_file() or video.depths is None)
        own = find_files(root, self.layout, **options)
        # What is replaced is not read: it may be what is wrong with the sequence.
        video = assemble_video(own if files.intrinsics is None else replace(own, intrinsics=None))
        bare = root.is_file() or video.depths is None
        return OpenedInput(select_frames(files.attach(video), selection), bare)

    def plan(self, opened: OpenedInput) -> CuePlan:
        """Decide where the cues come from.

        Raises:
            ConfigError: If options contradict each other.
        """
        of_file = self.masks is not None and self.masks not in _MADE_MASKS
        if of_file and self.mask_model is not None:
            raise ConfigError("--masks and --mask-model both say where masks come from; give one of them")
        if self.depth is not None and self.depth_model is not None:
            raise ConfigError("--depth and --depth-model both say where depth comes from; give one of them")
        if self.tracks is not None and self.track_model is not None:
            raise ConfigError("--tracks and --track-model both say where tracks come from; give one of them")
        if self.classes is not None and self.mask_model is None and not of_file:
            raise ConfigError("--classes says which classes of a segmenter may move; choose one with --mask-model")
        return plan_cues(
            opened.video,
            bare=opened.bare,
            depth_model=self.depth_model,
            masks=self.masks if self.masks in _MADE_MASKS else None,
            mask_model=self.mask_model,
            classes=self.classes,
            track_model=self.track_model,
        )

    def read(self) -> Sequence:
        """Open the sequence with all its cues; none is made here.

        Raises:
            InputError: If it cannot be read, or a cue is missing.
        """
        if self.cues is not None and has_manifest(Path(self.cues)):
            return load_cues(self.open().video, Path(self.cues))[0]
        if self == SequenceInput(self.root, **self.arguments()) and self.masks not in _MADE_MASKS:
            options, files = self._sources()
            if not files:
                return read_sequence(Path(self.root), self.layout, **options)
        video = self.open().video
        return as_sequence(replace(video, masks=None) if self.masks == "none" else video)

    @classmethod
    def load(cls, path: Path) -> SequenceInput:
        """Read what :meth:`save` wrote. Raises InputError."""
        text = read_text(path, _MAX_INPUT_BYTES, "a .json file")
        try:
            return TypeAdapter(cls).validate_json(text, strict=True)
        except (ValidationError, RecursionError) as error:
            detail = error.errors()[0] if isinstance(error, ValidationError) else {"loc": (), "msg": str(error)}
            what = " ".join(str(part) for part in (*detail["loc"], detail["msg"]))
            raise InputError(
                f"{path}: does not say what the run was made from ({what}); give the sequence with --sequence"
            ) from error

    def save(self, run: Path) -> None:
        """Write it into a run's folder. Raises OutputError."""
        stored = asdict(self)
        del stored["cues"]
        atomic_write_json(run / STORED_INPUT, stored)

    def _sources(self) -> tuple[LayoutOptions, CueFiles]:
        """Tell the names of cues within a sequence folder from files elsewhere."""
        root = Path(self.root)
        options = LayoutOptions(depth_gt_scale=self.depth_gt_scale, known_intrinsics=self.known_intrinsics)
        files: dict[str, Path] = {}
        if self.depth is not None:
            if _is_named_in(root, self.depth):
                options["depth"] = self.depth
            else:
                files["depth"] = Path(self.depth)
        uni4d = root.is_dir() and (self.layout == "uni4d" or (self.layout == "auto" and self._looks_like_uni4d()))
        if self.masks is not None and self.masks not in _MADE_MASKS:
            if uni4d and _is_named_in(root, self.masks):
                options["masks"] = self.masks
            else:
                files["masks"] = _beside(root, self.masks)
        if self.tracks is not None:
            if uni4d and _is_named_in(root, self.tracks):
                options["tracks"] = self.tracks
            else:
                files["tracks"] = _beside(root, self.tracks)
        return options, CueFiles(**files, intrinsics=self.calibration, classes=self.classes)

    def _looks_like_uni4d(self) -> bool:
        named = self.depth if self.depth is not None and _is_named_in(Path(self.root), self.depth) else None
        return detect_layout(Path(self.root), named) == "uni4d"


def _absolute(root: Path, value: str | None) -> str | None:
    """Return a cue's name as it is, and the path of a file elsewhere as an absolute one."""
    if value is None or value in _MADE_MASKS or _is_named_in(root, value):
        return value
    path = expanded(value)
    return str(resolved(path)) if is_present(path) else value


def _is_named_in(root: Path, value: str) -> bool:
    """Tell whether ``value`` can only be a name within the folder ``root``: it is there, or nowhere else either."""
    if not root.is_dir() or Path(value).is_absolute():
        return False
    return is_present(root / value) or is_present(root / f"{value}.npy") or not is_present(expanded(value))


def _is_there(name: str) -> bool:
    """Tell whether a path that was written down leads anywhere; one that cannot exist does not."""
    try:
        return is_present(Path(name))
    except InputError:
        return False


def _beside(root: Path, value: str) -> Path:
    """Return the file of that name in the sequence folder, if there is one, else the path as it is."""
    inside = root / value
    return inside if root.is_dir() and is_present(inside) else Path(value)


def shot_of(source: SequenceInput, first: int, count: int) -> SequenceInput:
    """Return ``count`` of the frames that an input selects, from its ``first`` on."""
    start = source.start + first * source.stride
    return replace(source, start=start, stop=start + (count - 1) * source.stride + 1)


def prepare_run_folder(
    folder: Path, source: SequenceInput, *, resume: bool, overwrite: bool, whole: bool = False
) -> None:
    """Make sure that a run may be written to ``folder``, and write down what it is made from.

    Args:
        folder: Of the run.
        source: What it will be made from; what is there is continued only if it was made from the same video.
        resume: Continue an earlier run.
        overwrite: Remove an earlier run's results.
        whole: Of the earlier run everything must have been the same, its cues too: nothing is made anew.

    Raises:
        OutputError: If the folder holds anything but a run, or a run that is neither to be continued nor
            replaced, or one of another video.
    """
    if claim_folder(folder, resume=resume, overwrite=overwrite, remedies=COMMAND_LINE):
        _check_same_video(folder, source, whole)
    source.save(folder)


def _check_same_video(folder: Path, source: SequenceInput, whole: bool) -> None:
    """Raise OutputError if the run in a folder was made from another video, or another part of it."""
    path = folder / STORED_INPUT
    if not path.is_file():
        return
    try:
        stored = SequenceInput.load(path)
    except InputError as error:
        raise OutputError(f"{error}; what the run was made from is not known: replace it with --overwrite") from error
    names = [f.name for f in fields(SequenceInput) if f.compare and (whole or f.name in _SAME_VIDEO)]
    moved = not _is_there(stored.root) and Path(stored.root).name == Path(source.root).name
    changed = [n for n in names if getattr(stored, n) != getattr(source, n) and not (n == "root" and moved)]
    if changed:
        was = ", ".join(f"{name} {getattr(stored, name)}" for name in changed)
        raise OutputError(
            f"{folder}: holds a run of {was}; continue it with the same, replace it with --overwrite, or choose "
            "another --out"
        )


def read_stored(stored: SequenceInput, run: Path) -> Sequence:
    """Read the sequence that a run was made from, see :meth:`SequenceInput.read`; one that is gone may have been moved.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        return stored.read()
    except InputError as error:
        if _is_there(stored.root):
            raise
        raise InputError(f"{run}: its sequence is needed ({error}); {IF_MOVED}") from error


def stored_input(folder: Path) -> SequenceInput:
    """Return which video a run was made from, with the cues that were made for it.

    Raises:
        InputError: If ``folder`` is no run, or the run does not say.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder of a run")
    path, summary = folder / STORED_INPUT, RunFolder(folder).summary
    if is_present(path):
        result = SequenceInput.load(path)
    elif is_present(summary):
        sequence = read_summary(summary).get("sequence", {})
        result = SequenceInput(sequence.get("root") or "")
    else:
        raise InputError(f"{folder}: is not the folder of a finished run; it has no {summary.name}")
    if not result.root:
        raise InputError(f"{folder}: does not say which sequence it was made from; give it with --sequence")
    own = folder / DEMO_SEQUENCE
    if not _is_there(result.root) and own.is_dir():
        return SequenceInput(str(own))
    return replace(result, cues=str(folder / CUE_FOLDER))
