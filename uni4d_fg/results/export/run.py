"""Exporting a run: all formats asked for are checked first, then written one by one, each whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from uni4d_fg.errors import OutputError
from uni4d_fg.files import atomic_folder, atomic_write_json, temporary_sibling, write_failure
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.results.export.model import ExportJob, ExportOptions, ExportReport
from uni4d_fg.results.export.registry import exporter
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_contents import EXPORT_MARKER, PYTHON, Remedies, export_files, foreign_files, is_export
from uni4d_fg.results.shot_list import refuse_split
from uni4d_fg.results.undistort import undistorted


def export_run(
    run: Run | str | Path,
    formats: Iterable[str],
    out: str | Path | None = None,
    options: ExportOptions | None = None,
    *,
    overwrite: bool = False,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] | None = None,
    remedies: Remedies = PYTHON,
) -> list[ExportReport]:
    """Write a run in the formats of other programs.

    Args:
        run: The run, or its folder: that does for formats without images. Those with images need a :class:`Run` that
            knows how to open its sequence.
        formats: Names in :data:`uni4d_fg.results.export.registry.FORMATS`.
        out: Each format gets a folder of its name in here; ``export`` in the run's folder if None.
        options: Choices.
        overwrite: Replace earlier exports. A folder that is no export is never touched.
        reporter: Progress.
        should_stop: Polled every frame; True ends with :class:`Cancelled`, finished formats kept.
        remedies: How the caller spells what to do about a folder that is in the way.

    Returns:
        One report per format, in the order asked for.

    Raises:
        InputError: If a format is unknown, the run cannot be opened, or something that a format needs is missing or
            damaged.
        OutputError: If a folder is in the way, or a file cannot be written. Formats before it are kept.
        MissingDependencyError: If a format needs a package that is not installed.
        Cancelled: If ``should_stop`` turned true.
    """
    chosen = {name: exporter(name) for name in formats}
    if not isinstance(run, Run):
        refuse_split(Path(run))
        run = Run(Path(run))
    root = run.folder.exports if out is None else Path(out)
    for name, one in chosen.items():
        one.require()
        _check_target(root / name, overwrite, remedies)
        if one.needs_images:
            run.need_sequence()
    reporter = reporter or SilentReporter()
    return [
        _export(run, name, root / name, options or ExportOptions(), reporter, should_stop or (lambda: False))
        for name in chosen
    ]


def _export(
    run: Run,
    name: str,
    target: Path,
    options: ExportOptions,
    reporter: Reporter,
    should_stop: Callable[[], bool],
) -> ExportReport:
    reporter.begin(name, run.num_frames)
    with _replaced_folder(target) as folder:
        chosen = exporter(name)
        straight = not run.reconstruction.lens.is_pinhole and (options.undistort or not chosen.has_lens)
        job = ExportJob(undistorted(run) if straight else run, folder, options, reporter, should_stop)
        if run.depth_is_unknown:
            job.warnings.append("the camera stays in one place: positions, points and depth are at an assumed distance")
        if straight:
            job.facts.append(f"undistorted: {run.reconstruction.lens.model} to PINHOLE")
        chosen.write(job)
        facts = {
            "format": name, "run": str(run.folder.root.resolve()), "figures": job.figures, "facts": job.facts,
            "files": export_files(folder),
        }  # fmt: skip
        atomic_write_json(folder / EXPORT_MARKER, facts)
    reporter.end()
    return ExportReport(name, target, tuple(job.facts), job.figures, tuple(job.warnings))


def _check_target(target: Path, overwrite: bool, remedies: Remedies) -> None:
    """Raise OutputError if ``target`` is in the way."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not is_export(target):
        raise OutputError(f"{target}: exists and is no export; {remedies.elsewhere}")
    if not overwrite:
        raise OutputError(f"{target}: exists already; replace it with {remedies.overwrite} or {remedies.elsewhere}")
    foreign = foreign_files(target)
    if foreign:
        raise OutputError(f"{target}: holds {foreign[0]}, which is not of the export; move it or {remedies.elsewhere}")


@contextmanager
def _replaced_folder(target: Path) -> Iterator[Path]:
    """Like :func:`atomic_folder`, but a folder that is there already stays until the new one is whole, and then goes.

    Raises:
        OutputError: If an ``OSError`` occurs in the block or while moving.
    """
    fresh = temporary_sibling(target)
    try:
        with atomic_folder(fresh) as folder:
            try:
                yield folder
            except OutputError as error:
                raise OutputError(str(error).replace(str(folder), str(target))) from error
            except OSError as error:
                raise write_failure(target, error) from error
        _move(fresh, target)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _move(fresh: Path, target: Path) -> None:
    """Move a finished folder to its place; what is there goes, or comes back if that fails."""
    old = temporary_sibling(target)
    try:
        if target.exists():
            os.replace(target, old)
        os.replace(fresh, target)
    except OSError as error:
        if old.exists():
            with suppress(OSError):
                os.replace(old, target)
        raise write_failure(target, error) from error
    shutil.rmtree(old, ignore_errors=True)
