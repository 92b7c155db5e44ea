"""The verb ``stream``: a sequence frame by frame, in bounded memory."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import print_json
from uni4d_fg.cli.interruption import Interruption, resume_command
from uni4d_fg.cli.options import LayoutChoice
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.runs import SequenceInput, prepare_run_folder
from uni4d_fg.errors import Cancelled, ConfigError, InputError
from uni4d_fg.reading import resolved
from uni4d_fg.results.run_contents import COMMAND_LINE, run_lock

if TYPE_CHECKING:
    from uni4d_fg.progress import Reporter
    from uni4d_fg.slam.incremental.model import FrameUpdate


def stream(
    seq: options.VideoPath,
    out: Annotated[Path | None, typer.Option(help="Folder of the run; runs/NAME-stream if not given.")] = None,
    config: options.ConfigChoice = None,
    changes: options.Overrides = None,
    online_tracks: Annotated[
        bool, typer.Option("--online-tracks", help="Track online even if the sequence brings tracks.")
    ] = False,
    resume: options.Resume = False,
    overwrite: options.Overwrite = False,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    max_size: options.MaxSize = None,
    layout: options.Layout = LayoutChoice.auto,
    depth: options.DepthFiles = None,
    masks: options.MaskFiles = None,
    tracks: options.TrackFiles = None,
    intrinsics: options.IntrinsicsFile = None,
    known_intrinsics: options.KnownIntrinsics = False,
    odometry: options.OdometryFile = None,
    gps: options.GpsFile = None,
    relative_poses: options.RelativePosesFile = None,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Reconstruct frame by frame over a sliding window: cameras, static and moving points of a video of any length."""
    from uni4d_fg.config.load import load_config
    from uni4d_fg.cues.depth_settings import settings_for_depth
    from uni4d_fg.pipeline.measurements import MeasurementFiles, read_measurements
    from uni4d_fg.pipeline.stream import check_stream, stream_sequence

    settings = load_config(config, changes or ())
    if masks == "motion":
        raise ConfigError("masks from motion need the whole video; make them with 'uni4d-fg cues', or give files")
    root = _sequence_of(seq, depth)
    source = SequenceInput.of(
        root, layout, depth, masks, tracks, depth_gt_scale=1000.0, known_intrinsics=known_intrinsics,
        intrinsics=intrinsics, start=start, stop=stop, stride=stride, max_size=max_size,
    )  # fmt: skip
    run = out or Path("runs") / f"{root.stem if root.is_file() else resolved(root).name}-stream"
    if source.open().video.depths is None:
        raise InputError(
            f"{root}: has no depth, which 'stream' needs of every frame: give --depth FOLDER or FILE.npy, or make it "
            "first with 'uni4d-fg cues'"
        )
    sequence = source.read()
    settings = settings_for_depth(settings, sequence)
    if online_tracks:
        sequence = replace(sequence, tracks=None)
    files = MeasurementFiles(odometry, gps, relative_poses)
    # What is wrong is said before an earlier run is replaced.
    check_stream(sequence, settings)
    read_measurements(files, sequence.timestamps, settings.measurements)
    with run_lock(run, COMMAND_LINE), Interruption() as interrupted, progress_reporter(quiet) as reporter:
        prepare_run_folder(run, source, resume=resume, overwrite=overwrite, whole=True)
        reporter.begin("stream", sequence.num_frames)
        try:
            summary = stream_sequence(
                sequence, run, settings, resume=resume, on_frame=_LiveProgress(reporter), should_stop=interrupted,
                measurements=files,
            )  # fmt: skip
        except Cancelled as error:
            raise Cancelled(f"{error}: results so far are in {run}; continue with: {resume_command()}") from error
        reporter.end()
    if json:
        print_json(summary.to_dict())
    else:
        typer.echo("\n".join([*summary.lines(), f"results: {run}"]))


def _sequence_of(path: Path, depth: str | None) -> Path:
    """Return the sequence folder that a video file is the video of; the path itself for anything else."""
    beside = path.parent / "depth_cue"
    belongs = path.is_file() and depth is None and (beside.is_dir() or beside.with_suffix(".npy").is_file())
    return path.parent if belongs else path


class _LiveProgress:
    """Turns updates into one line: frame rate, window, reprojection error, memory."""

    def __init__(self, reporter: Reporter):
        self.reporter = reporter
        self._last = time.perf_counter()
        self._interval = 0.0

    def __call__(self, update: FrameUpdate) -> None:
        from uni4d_fg.pipeline.summary import peak_memory_mb

        now = time.perf_counter()
        elapsed, self._last = now - self._last, now
        self._interval = elapsed if self._interval == 0.0 else 0.9 * self._interval + 0.1 * elapsed
        rate = 1.0 / max(self._interval, 1e-9)
        self.reporter.advance(
            update.frame + 1,
            f"frame {update.frame} {update.status.value}: {rate:.1f}/s, window {update.window}, "
            f"{update.num_tracks} tracks, {update.reprojection_error_px:.2f} px, {peak_memory_mb():.0f} MB",
        )
