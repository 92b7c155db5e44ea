"""Guarding run folders, and remembering which sequence a run was made from."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import atomic_write_json, write_failure
from uni4d_fg.reconstruction.run_folder import RunFolder
from uni4d_fg.sequence.model import Sequence
from uni4d_fg.sequence.read import read_sequence

STORED_INPUT = "input.json"
DEMO_SEQUENCE = "sequence"


@dataclass(frozen=True)
class SequenceInput:
    """How a sequence was asked for on the command line; kept beside a run's results."""

    root: str
    layout: str = "auto"
    depth: str | None = None
    masks: str | None = None
    tracks: str | None = None
    depth_gt_scale: float = 1000.0
    known_intrinsics: bool = False

    @classmethod
    def of(
        cls, root: Path, layout: LayoutChoice, depth: str | None, masks: str | None, tracks: str | None, *,
        depth_gt_scale: float, known_intrinsics: bool,
    ) -> SequenceInput:  # fmt: skip
        """Take over command-line values; the folder becomes absolute."""
        return cls(str(root.resolve()), layout.value, depth, masks, tracks, depth_gt_scale, known_intrinsics)

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments of :func:`read_sequence` and :func:`validate_sequence`."""
        return {name: value for name, value in asdict(self).items() if name != "root"}

    def read(self) -> Sequence:
        """Read the sequence. Raises InputError."""
        return read_sequence(Path(self.root), **self.arguments())

    def save(self, run: Path) -> None:
        """Write it into a run's folder. Raises OutputError."""
        atomic_write_json(run / STORED_INPUT, asdict(self))


def is_run(folder: Path) -> bool:
    """Tell whether a folder holds a run, finished or not."""
    run = RunFolder(folder)
    if run.config.is_file() and (run.summary.is_file() or (folder / "stages").is_dir()):
        return True
    try:
        stored = _read_json(folder / STORED_INPUT)
    except InputError:
        return False
    return set(stored) == {field.name for field in fields(SequenceInput)}


def prepare_run_folder(folder: Path, *, resume: bool, overwrite: bool) -> None:
    """Make sure that a run may be written to ``folder``; ``overwrite`` removes an earlier run's results.

    Raises:
        OutputError: If the folder holds anything but a run, or a run that is neither to be continued nor
            replaced.
    """
    if resume and overwrite:
        raise OutputError("--resume and --overwrite exclude each other; give one of them")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; choose another --out")
    if not folder.exists() or not any(folder.iterdir()):
        return
    if not is_run(folder):
        raise OutputError(f"{folder}: is not empty and holds no run; choose another --out")
    if overwrite:
        remove_results(folder)
    elif not resume:
        raise OutputError(f"{folder}: holds a run already; continue it with --resume or replace it with --overwrite")


def remove_results(folder: Path) -> None:
    """Remove what runs write, and nothing else.

    Raises:
        OutputError: If something cannot be removed.
    """
    run = RunFolder(folder)
    files = (run.reconstruction, run.trajectory, run.depth, run.summary, run.config, run.labels, folder / STORED_INPUT)
    try:
        for path in files:
            path.unlink(missing_ok=True)
        for path in (run.static_cloud.parent, run.trajectory_picture.parent, folder / "stages"):
            if path.is_dir():
                shutil.rmtree(path)
    except OSError as error:
        raise write_failure(Path(error.filename or folder), error) from error


def stored_input(folder: Path) -> SequenceInput:
    """Return which sequence a run was made from.

    Raises:
        InputError: If ``folder`` is no run, or the run does not say.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder of a run")
    path, summary = folder / STORED_INPUT, RunFolder(folder).summary
    if path.exists():
        stored = _read_json(path)
    elif summary.exists():
        sequence = _read_json(summary).get("sequence")
        stored = {"root": sequence.get("root")} if isinstance(sequence, dict) else {}
    else:
        raise InputError(f"{folder}: is not the folder of a finished run; it has no {summary.name}")
    try:
        result = SequenceInput(**stored)
    except TypeError:
        result = SequenceInput("")
    if not result.root or not isinstance(result.root, str):
        raise InputError(f"{folder}: does not say which sequence it was made from; give it with --sequence")
    own = folder / DEMO_SEQUENCE
    if not Path(result.root).is_dir() and own.is_dir():
        return SequenceInput(str(own))
    return result


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error}); give the sequence with --sequence") from error
    return value if isinstance(value, dict) else {}
