"""Verbs that reconstruct: ``reconstruct``, ``demo``."""

from __future__ import annotations

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import duration, print_json
from uni4d_fg.cli.forecast import Forecast, expected_shares
from uni4d_fg.cli.interruption import Interruption, resume_command
from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.runs import CUE_FOLDER, SequenceInput, prepare_run_folder
from uni4d_fg.errors import Cancelled, ConfigError
from uni4d_fg.results.run_contents import COMMAND_LINE, mark_run, run_lock

if TYPE_CHECKING:
    from uni4d_fg.config.models import Config
    from uni4d_fg.cues.plan import CuePlan, CueReport
    from uni4d_fg.frontend.measurements.imu import ImuSamples
    from uni4d_fg.frontend.sequence.model import Sequence, Video
    from uni4d_fg.pipeline import RunSummary
    from uni4d_fg.pipeline.measurements import MeasurementFiles
    from uni4d_fg.pipeline.workers.options import WorkerOptions


def reconstruct(
    seq: options.VideoPath,
    out: Annotated[Path | None, typer.Option(help="Folder of the run; runs/NAME if not given.")] = None,
    config: options.ConfigChoice = None,
    changes: options.Overrides = None,
    solver: options.Solver = None,
    window: options.WindowFrames = None,
    overlap: options.WindowOverlap = None,
    workers: options.WindowProcesses = None,
    scheduler: options.WindowScheduler = None,
    time_limit: options.WindowTimeLimit = None,
    resume: options.Resume = False,
    overwrite: options.Overwrite = False,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    max_size: options.MaxSize = None,
    depth: options.DepthFiles = None,
    depth_model: options.DepthModel = None,
    masks: options.MaskFiles = None,
    mask_model: options.MaskModel = None,
    classes: options.Classes = None,
    tracks: options.TrackFiles = None,
    track_model: options.TrackModel = None,
    intrinsics: options.IntrinsicsFile = None,
    imu: options.Imu = None,
    odometry: options.OdometryFile = None,
    gps: options.GpsFile = None,
    relative_poses: options.RelativePosesFile = None,
    one_shot: options.OneShot = False,
    layout: options.Layout = LayoutChoice.auto,
    depth_gt_scale: options.DepthScale = 1000.0,
    known_intrinsics: options.KnownIntrinsics = False,
    keep_cues: Annotated[
        bool, typer.Option("--keep-cues", help="Keep cues that only led to others; --resume makes them again else.")
    ] = False,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Reconstruct a video: cameras, static points, motion and depth, written to a run folder.

    Each shot of a video with cuts becomes a run of its own (RUN/shots/000, ...), unless other measurements (--imu,
    --odometry, --gps, --relative-poses) make it one recording.

    Cues that the video does not bring are made: depth by a network or from camera motion, masks by a segmenter or from
    motion, tracks by a network or the built-in tracker.
    """
    from uni4d_fg.cli import shots
    from uni4d_fg.config.load import load_config
    from uni4d_fg.cues.depth_settings import settings_for_depth
    from uni4d_fg.cues.intermediate import drop_intermediate
    from uni4d_fg.frontend.measurements.imu import read_imu
    from uni4d_fg.frontend.sequence.naming import order_warnings
    from uni4d_fg.pipeline.asked import check_asked
    from uni4d_fg.pipeline.measurements import MeasurementFiles, read_measurements
    from uni4d_fg.pipeline.usable_cues import check_given_cues
    from uni4d_fg.pipeline.warnings import intrinsics_warnings
    from uni4d_fg.pipeline.workers.options import WorkerOptions
    from uni4d_fg.results.shot_list import check_same_split

    began = time.perf_counter()
    chosen = [] if solver is None else [f"solver={solver.value}"]
    chosen += [] if window is None else [f"windows.frames={window}"]
    chosen += [] if overlap is None else [f"windows.overlap={overlap}"]
    settings = load_config(config, [*(changes or ()), *chosen])
    work = None
    if workers is not None or scheduler is not None:
        work = WorkerOptions(workers, scheduler)
        if time_limit is not None:
            work = replace(work, time_limit=60.0 * time_limit)
    elif time_limit is not None:
        raise ConfigError("--time-limit is for processes that solve windows: add --window N and --workers N")
    if work is not None and settings.windows.frames is None:
        raise ConfigError("--workers and --scheduler are for the windows of a long video: add --window N")
    if overlap is not None and settings.windows.frames is None:
        raise ConfigError("--overlap is for the windows of a long video: add --window N")
    source = SequenceInput.of(
        seq, layout, depth, masks, tracks, depth_gt_scale=depth_gt_scale, known_intrinsics=known_intrinsics,
        intrinsics=intrinsics, start=start, stop=stop, stride=stride, max_size=max_size, depth_model=depth_model,
        mask_model=mask_model, classes=class_list(classes), track_model=track_model,
    )  # fmt: skip
    run = out or Path("runs") / (seq.stem if seq.is_file() else Path(source.root).name)
    samples = None if imu is None else read_imu(imu)
    opened = source.open()
    plan = source.plan(opened)
    plan.check()
    check_asked(opened.video, settings, samples)
    check_given_cues(opened.video, settings.input, plan)
    if not (quiet or json):
        for text in [*order_warnings(opened.video.frame_names), *intrinsics_warnings(opened.video)]:
            typer.echo(f"warning: {text}", err=True)  # before the work: it would all be in vain
    files = MeasurementFiles(odometry, gps, relative_poses)
    is_measured = any(given is not None for given in (imu, odometry, gps, relative_poses))
    # What is wrong with a file is said before anything is made.
    read_measurements(files, opened.video.timestamps, settings.measurements)

    def solve(video: Video, folder: Path, again: bool, warnings: tuple[str, ...] = ()) -> tuple[RunSummary, Sequence]:
        forecast = Forecast(expected_shares(video.num_frames, video.image_size, settings, plan, video.tracks))
        sequence, report = run_cues(video, plan, folder, settings, quiet=quiet, forecast=forecast)
        chosen = settings_for_depth(settings, sequence)
        summary = run_pipeline(
            sequence, folder, chosen, resume=again, quiet=quiet, cues=report, measurements=files, imu=samples,
            warnings=warnings, forecast=forecast, workers=work,
        )  # fmt: skip
        if not keep_cues:
            drop_intermediate(folder / CUE_FOLDER)
        return summary, sequence

    with run_lock(run, COMMAND_LINE):
        prepare_run_folder(run, source, resume=resume, overwrite=overwrite)
        looked_for = settings.shots.split == "auto" and not is_measured
        cuts = shots.cuts_of(opened.video, settings.shots) if looked_for else ()
        split = bool(cuts) and not one_shot
        check_same_split(run, split, resume=resume, remedies=COMMAND_LINE)
        if split:
            found = shots.shots_between(cuts, source, opened.video.num_frames, settings.shots.min_frames)
            done, summaries, failure = shots.reconstruct_shots(
                run, source, opened.video, found, solve, resume=resume, overwrite=overwrite
            )
            shots.print_shots(run, done, summaries, json)
            if failure is not None:
                raise failure
            return
        warnings = (shots.one_shot_warning(cuts, source),) if cuts else ()
        summary, _ = solve(opened.video, run, resume, warnings)
    if json:
        print_json(summary.to_dict())
    else:
        typer.echo("\n".join([*summary.lines(), *closing_lines(run, time.perf_counter() - began)]))


def closing_lines(run: Path, seconds: float) -> list[str]:
    """Return what is said at the end of a run: how long it took, where it is, how large, and what to do with it."""
    size = sum(path.stat().st_size for path in run.rglob("*") if path.is_file())
    name = shlex.quote(str(run))
    return [
        f"total: {duration(seconds)}, {size / 1e6:.0f} MB on disk",
        f"results: {run}",
        f"next: uni4d-fg view {name} | uni4d-fg report {name} | uni4d-fg export {name} --to colmap",
    ]


def demo(
    out: Annotated[Path, typer.Option(help="Folder of the run.")] = Path("runs/demo"),
    config: options.ConfigChoice = None,
    changes: options.Overrides = None,
    fast: Annotated[bool, typer.Option("--fast", help="A smaller scene and the preset 'fast'.")] = False,
    resume: options.Resume = False,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Make a moving scene, reconstruct it, and score the result against the exact truth."""
    from uni4d_fg.cli import demonstration
    from uni4d_fg.config.load import load_config
    from uni4d_fg.cues.plan import CuePlan
    from uni4d_fg.results.evaluate.run import evaluate_run

    settings = load_config(config or ("fast" if fast else None), changes or ())
    with demonstration.demo_folder(out, resume=resume):
        source = demonstration.demo_input(out, fast=fast, quiet=quiet)
        mark_run(out)
        source.save(out)
        sequence = source.read()
        shares = expected_shares(sequence.num_frames, sequence.image_size, settings, CuePlan(), sequence.tracks)
        summary = run_pipeline(sequence, out, settings, resume=resume, quiet=quiet, forecast=Forecast(shares))
        report = evaluate_run(out, sequence)
    if json:
        print_json({"summary": summary.to_dict(), "evaluation": report.to_dict()})
    else:
        typer.echo("\n".join(demonstration.demo_lines(out, sequence, summary, report)))


def run_cues(
    video: Video, plan: CuePlan, run: Path, config: Config, *, quiet: bool, forecast: Forecast | None = None
) -> tuple[Sequence, CueReport | None]:
    """Make the cues that are missing, with progress, in ``RUN/cues``; None when there was nothing to make.

    Raises:
        Uni4dFgError: As :func:`~uni4d_fg.cues.gather.gather_cues`.
    """
    from uni4d_fg.frontend.sequence.assemble import as_sequence

    if plan.is_given:
        return as_sequence(replace(video, masks=None) if plan.masks == "none" else video), None
    from uni4d_fg.cues.gather import gather_cues  # what makes cues loads much

    folder = run / CUE_FOLDER
    began = time.perf_counter()
    with Interruption() as stop, progress_reporter(quiet, forecast) as reporter:
        try:
            sequence, report = gather_cues(
                video, plan, folder, config, reporter=reporter, should_stop=stop, track_cache=run / "stages"
            )
            return sequence, replace(report, seconds=time.perf_counter() - began)
        except Cancelled as error:
            raise Cancelled(f"{error}; what is done is in {run}; continue with: {resume_command()}") from error


def class_list(classes: str | None) -> tuple[str, ...] | None:
    """Return the names in a list that is separated by commas.

    Raises:
        ConfigError: If there is no name in it.
    """
    if classes is None:
        return None
    names = tuple(name.strip() for name in classes.split(",") if name.strip())
    if not names:
        raise ConfigError(f"--classes {classes!r}: give names separated by commas, such as person,dog")
    return names


def run_pipeline(
    sequence: Sequence, run: Path, config: Config, *, resume: bool, quiet: bool, cues: CueReport | None = None,
    imu: ImuSamples | None = None,
    measurements: MeasurementFiles | None = None, warnings: tuple[str, ...] = (), forecast: Forecast | None = None,
    workers: WorkerOptions | None = None,
) -> RunSummary:  # fmt: skip
    """Reconstruct with progress; Ctrl-C ends the run cleanly and says how to go on.

    Raises:
        Uni4dFgError: As the pipeline does.
    """
    from uni4d_fg.pipeline import reconstruct as reconstruct_sequence

    with Interruption() as stop, progress_reporter(quiet, forecast) as reporter:
        try:
            return reconstruct_sequence(
                sequence, run, config, resume=resume, reporter=reporter, should_stop=stop,
                cues=None if cues is None else cues.to_dict(), measurements=measurements, imu=imu,
                warnings=warnings, workers=workers,
            )  # fmt: skip
        except Cancelled as error:
            raise Cancelled(f"finished stages are kept in {run}; continue with: {resume_command()}") from error
