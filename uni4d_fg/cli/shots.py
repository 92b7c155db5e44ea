"""Splitting a video at its cuts: each shot is a selection of the same input, and a run of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from uni4d_fg.cli.console import one_line, print_error, print_json
from uni4d_fg.cli.interruption import Interruption, resume_command
from uni4d_fg.cli.runs import SequenceInput, prepare_run_folder, shot_of
from uni4d_fg.config.shots import ShotsConfig
from uni4d_fg.errors import Cancelled, InputError, Uni4dFgError
from uni4d_fg.frontend.sequence.problems import some_of
from uni4d_fg.frontend.sequence.selection import FrameSelection, select_frames
from uni4d_fg.frontend.shots.cuts import Cut, find_cuts
from uni4d_fg.results.run_contents import COMMAND_LINE, run_lock
from uni4d_fg.results.shot_list import Shot, shot_folder, write_shots

if TYPE_CHECKING:
    from uni4d_fg.frontend.sequence.model import Sequence, Video
    from uni4d_fg.pipeline import RunSummary

Solve = Callable[["Video", Path, bool], "tuple[RunSummary, Sequence]"]
"""Reconstructs a video into a run folder; whether it may take over what is there."""


def cuts_of(video: Video, config: ShotsConfig) -> tuple[Cut, ...]:
    """Look for cuts; Ctrl-C ends the search.

    Raises:
        InputError: If a frame cannot be read.
        Cancelled: If Ctrl-C was pressed.
    """
    with Interruption() as stop:
        return find_cuts(video.images, config, stop)


def shots_between(cuts: tuple[Cut, ...], source: SequenceInput, num_frames: int, min_frames: int) -> list[Shot]:
    """Return the shots of a video, those that are too short without a folder.

    Raises:
        InputError: If all of them are too short.
    """
    begins, ends = [0, *(cut.start for cut in cuts)], [*(cut.stop for cut in cuts), num_frames]
    shots: list[Shot] = []
    for begin, end in zip(begins, ends, strict=True):
        if end <= begin:
            continue
        part = shot_of(source, begin, end - begin)
        assert part.stop is not None
        short = end - begin < min_frames
        message = f"left out: it has fewer than {min_frames} frames (shots.min_frames)" if short else ""
        folder = None if short else shot_folder(len(shots))
        shots.append(Shot(folder, part.start, part.stop, end - begin, message=message))
    if all(shot.folder is None for shot in shots):
        raise InputError(
            f"{source.root}: its cuts leave no shot of {min_frames} frames (shots.min_frames), only "
            f"{some_of([f'{shot.start} to {shot.stop - 1}' for shot in shots], 3)}; solve it as one with --one-shot if "
            "these are no cuts"
        )
    return shots


def one_shot_warning(cuts: tuple[Cut, ...], source: SequenceInput) -> str:
    """Return what to distrust in a video with cuts that is solved as one shot."""
    frames = ", ".join(str(source.start + cut.frame * source.stride) for cut in cuts)
    return (
        f"there are cuts at frame {frames}: it was solved as one shot nevertheless, and what lies behind one is wrong"
    )


def reconstruct_shots(
    run: Path, source: SequenceInput, video: Video, shots: list[Shot], solve: Solve, *, resume: bool, overwrite: bool
) -> tuple[list[Shot], dict[str, RunSummary], Uni4dFgError | None]:
    """Reconstruct every shot that is long enough; one that fails does not keep the others from being tried.

    Args:
        run: Folder of the whole run, prepared and locked.
        source: What was asked for.
        video: Its frames.
        shots: Its shots.
        solve: Reconstructs one of them.
        resume: Take over what is there.
        overwrite: Replace it.

    Returns:
        The shots with what became of them, the summaries by folder, and the first failure.

    Raises:
        Cancelled: If Ctrl-C was pressed; shots that are done are kept.
        OutputError: If a folder cannot be written.
    """
    done, summaries = list(shots), {}
    failure: Uni4dFgError | None = None
    write_shots(run, done)
    for index, shot in enumerate(shots):
        if shot.folder is None:
            print_error(f"frames {shot.start} to {shot.stop - 1}: {shot.message}", "warning")
            continue
        folder, first = run / shot.folder, (shot.start - source.start) // source.stride
        try:
            with run_lock(folder, COMMAND_LINE):
                part = replace(source, start=shot.start, stop=shot.stop)
                prepare_run_folder(folder, part, resume=resume, overwrite=overwrite)
                frames = select_frames(video, FrameSelection(first, first + shot.num_frames))
                summary, sequence = solve(frames, folder, resume)
            summaries[shot.folder] = summary
            done[index] = replace(shot, exit_code=0, ate_m=_ate(folder, sequence))
        except Cancelled as error:
            raise Cancelled(f"{error} (shot {shot.folder}; continue with: {resume_command()})") from error
        except Uni4dFgError as error:
            failure = failure or error
            done[index] = replace(shot, exit_code=error.exit_code, message=one_line(error))
            print_error(f"{shot.folder}: {one_line(error)}")
        write_shots(run, done)
    return done, summaries, failure


def _ate(folder: Path, sequence: Sequence) -> float | None:
    """Return the trajectory error of a shot, meters; None without truth."""
    import numpy as np

    from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
    from uni4d_fg.results.io import load_reconstruction
    from uni4d_fg.results.run_folder import RunFolder

    truth = sequence.ground_truth.world_T_cam
    if truth is None:
        return None
    known = np.isfinite(truth).all(axis=(1, 2))
    if known.sum() < 3:
        return None
    found = load_reconstruction(RunFolder(folder).reconstruction).world_T_cam
    return float(evaluate_trajectory(found[known], truth[known]).ate_m)


def print_shots(run: Path, shots: list[Shot], summaries: dict[str, RunSummary], json: bool) -> None:
    """Print what became of every shot."""
    if json:
        print_json(
            {"shots": [{**asdict(s), "summary": summaries[s.folder].to_dict() if s.folder in summaries else None}
                       for s in shots]}
        )  # fmt: skip
        return
    for shot in shots:
        typer.echo(shot.line())
        lines = summaries[shot.folder].lines() if shot.folder in summaries else []
        for line in lines:
            typer.echo(f"    {line}")
    typer.echo(f"results: {run}")
