"""Solve a sequence as a stream, into a run folder."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.config.load import dump_config
from uni4d_fg.config.models import Config
from uni4d_fg.cues.scale_notes import NOT_METRIC_GIVEN
from uni4d_fg.errors import Cancelled, ConfigError
from uni4d_fg.files import atomic_write_json, atomic_write_text, remove_file
from uni4d_fg.frontend.sequence.frame_checks import usable_depth
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.naming import order_warnings
from uni4d_fg.optim.added_factors import FactorSource, checked_sources
from uni4d_fg.pipeline.assemble import write_result
from uni4d_fg.pipeline.checks import check_sequence
from uni4d_fg.pipeline.leftovers import remove_leftovers
from uni4d_fg.pipeline.lens import check_parameters
from uni4d_fg.pipeline.loops import close_stream
from uni4d_fg.pipeline.measurements import MeasurementFiles, read_measurements
from uni4d_fg.pipeline.stream_folder import StreamFolder
from uni4d_fg.pipeline.stream_key import StreamKey
from uni4d_fg.pipeline.summary import peak_memory_mb, versions
from uni4d_fg.pipeline.usable_cues import check_given_cues
from uni4d_fg.pipeline.warnings import found_focal_warnings, intrinsics_warnings, scene_warnings, started_from_a_guess
from uni4d_fg.results.run_contents import mark_run, run_lock
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.incremental.model import FrameStatus, FrameTracks, FrameUpdate
from uni4d_fg.slam.incremental.reconstructor import IncrementalReconstructor, check_incremental

OnFrame = Callable[[FrameUpdate], None]
"""Told of every frame."""


@dataclass
class StreamSummary:
    """What a stream did, as written to ``summary.json``."""

    name: str
    num_frames: int
    resumed_from: int
    counts: dict[str, int]
    """Frames per status, those of earlier processes too."""
    seconds: dict[str, float]
    """Per part and in all, those of earlier processes up to the checkpoint too."""
    peak_memory_mb: float
    doubts: list[str] = field(default_factory=list)
    """What to distrust in the result, one sentence each."""
    facts: list[str] = field(default_factory=list)
    """Loops that were closed, and what measurements there were."""
    metric: bool = True
    """Whether lengths are in meters."""

    @property
    def bridged(self) -> int:
        """Frames that were bridged."""
        return self.counts.get(FrameStatus.BRIDGED.value, 0)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "sequence": {"name": self.name, "num_frames": self.num_frames},
            "cues": {"metric": self.metric},
            "stages": {
                "stream": {
                    **{k: v for k, v in self.__dict__.items() if k not in ("doubts", "metric")},
                    "bridged": self.bridged,
                    "name": "stream",
                }
            },
            "warnings": self.warnings(),
            "versions": versions(),
        }

    def warnings(self) -> list[str]:
        """Return what to distrust."""
        text = f"{self.bridged} frame(s) had too few static tracks and are bridged by constant velocity"
        return [*([text] if self.bridged else []), *self.doubts]

    def lines(self) -> list[str]:
        """Return a few lines of text."""
        done = sum(self.counts.values())
        rate = done / max(self.seconds.get("total", 0.0), 1e-9)
        parts = ", ".join(f"{name} {value:.1f} s" for name, value in self.seconds.items() if name != "total")
        out = [f"{self.name}: {self.num_frames} frames ({', '.join(f'{n} {s}' for s, n in self.counts.items())})"]
        if self.resumed_from:
            out.append(f"resumed at frame {self.resumed_from}")
        out.append(f"{rate:.1f} frames a second, {self.peak_memory_mb:.0f} MB; {parts}")
        out += self.facts
        return out + [f"warning: {text}" for text in self.warnings()]


def check_stream(sequence: Sequence, config: Config) -> None:
    """Check a sequence and a configuration before a folder is touched.

    Raises:
        InputError: If parts of the sequence are missing or contradict each other, or the principal point is outside.
        ConfigError: If it cannot be solved frame by frame, or asks for a camera model whose parameters are not given.
    """
    check_sequence(sequence)
    check_given_cues(sequence, config.input)
    check_parameters(sequence, config, "in a stream", "find it with `uni4d-fg reconstruct`")
    if sequence.zoom is not None:
        raise ConfigError("a stream has one focal length, and this camera zooms; use `uni4d-fg reconstruct`")
    if config.camera.zoom == "on":
        raise ConfigError("a stream has one focal length: leave camera.zoom 'auto' or 'off'")
    if config.input.poses == "fixed":
        raise ConfigError(
            "a stream finds its cameras itself: leave input.poses 'estimate', or use `uni4d-fg reconstruct`"
        )
    check_incremental(config)


def not_in_streams(config: Config) -> list[str]:
    """Return a warning of what a configuration asks for and a stream leaves out; empty where there is nothing."""
    asked = {
        "input.poses": config.input.poses != "estimate",
        "camera.rolling_shutter": config.camera.given_readout is not None,
        "joint.enabled": config.joint.enabled,
        "rigid_objects.enabled": config.rigid_objects.enabled,
        "windows.frames": config.windows.frames is not None,
    }
    left_out = [name for name, is_asked in asked.items() if is_asked]
    return [f"a stream leaves out {', '.join(left_out)}; `uni4d-fg reconstruct` has it"] if left_out else []


def stream_sequence(
    sequence: Sequence,
    run_dir: Path,
    config: Config,
    *,
    resume: bool = False,
    on_frame: OnFrame | None = None,
    should_stop: Callable[[], bool] | None = None,
    additions: Iterable[FactorSource] = (),
    measurements: MeasurementFiles | None = None,
) -> StreamSummary:
    """Solve a sequence frame by frame; results are written as frames leave the window.

    Args:
        sequence: Frames and cues, read one by one; its own tracks are used if it brings any.
        run_dir: Folder of the run.
        config: The whole configuration.
        resume: Go on from the last checkpoint in ``run_dir`` if there is one.
        on_frame: Told of every frame.
        should_stop: Polled before every frame; True writes a checkpoint and ends with :class:`Cancelled`.
        additions: Factors and variables of your own, see :mod:`uni4d_fg.optim.added_factors`.
        measurements: Files of odometry, GPS and relative poses.

    Raises:
        InputError: If a cue cannot be read, or the checkpoint does not fit.
        ConfigError: As :func:`check_stream`.
        DegenerateProblemError: If there is no frame.
        SolverError: If a window cannot be solved.
        OutputError: If a result cannot be written.
        Cancelled: If ``should_stop`` turned true.
    """
    check_stream(sequence, config)
    with run_lock(run_dir):
        mark_run(run_dir)
        measured = read_measurements(measurements or MeasurementFiles(), sequence.timestamps, config.measurements)
        sources = (*checked_sources(additions), *measured.sources)
        summary = _stream(sequence, run_dir, config, resume, on_frame, should_stop, sources)
        summary = replace(
            summary,
            facts=[*summary.facts, *measured.facts],
            doubts=[
                *order_warnings(sequence.frame_names),
                *intrinsics_warnings(sequence),
                *not_in_streams(config),
                *([] if sequence.depth_is_metric else [NOT_METRIC_GIVEN]),
                *summary.doubts,
                *measured.warnings,
            ],
            metric=sequence.depth_is_metric,
        )
        atomic_write_json(RunFolder(run_dir).summary, summary.to_dict())
        return summary


def _stream(
    sequence: Sequence, run_dir: Path, config: Config, resume: bool, on_frame: OnFrame | None,
    should_stop: Callable[[], bool] | None, sources: tuple[FactorSource, ...],
) -> StreamSummary:  # fmt: skip
    folder, key = StreamFolder(run_dir), StreamKey(sequence, config, sources)
    solver = IncrementalReconstructor(sequence.intrinsics, sequence.image_size, config, folder, sources, sequence.lens)
    # What is there is touched only when it is known that this goes on from it, or replaces it.
    before = folder.resume(solver, key, should_stop) if resume else None
    remove_leftovers(RunFolder(run_dir))
    if before is None:
        remove_file(RunFolder(run_dir).trajectory)
        remove_file(folder.checkpoint)
    atomic_write_text(RunFolder(run_dir).config, dump_config(config))
    first, began = solver.num_frames, time.perf_counter()
    seconds = before or {}
    earlier = seconds.get("total", 0.0)

    def save() -> None:
        seconds["total"] = earlier + time.perf_counter() - began
        folder.save(solver, key, seconds)

    for frame in range(first, sequence.num_frames):
        if should_stop is not None and should_stop():
            save()
            raise Cancelled(f"stopped before frame {frame}; --resume goes on from there")
        image, depth, mask = sequence.images[frame], sequence.depths[frame], sequence.masks[frame]
        # Some frame has usable depth, as was checked: one that is too far at the start is a frame that lacks it.
        usable = np.where(usable_depth(depth, config.input), depth, np.nan)
        update = solver.add_frame(image, usable, mask, _tracks(sequence, frame), float(sequence.timestamps[frame]))
        key.take(image, depth, mask)
        for part, value in update.seconds.items():
            seconds[part] = seconds.get(part, 0.0) + value
        if on_frame is not None:
            on_frame(update)
        if (frame + 1) % config.incremental.checkpoint_interval == 0:
            since = time.perf_counter()
            save()
            seconds["checkpoint"] = seconds.get("checkpoint", 0.0) + time.perf_counter() - since
    save()
    solver.flush()
    finished = folder.read()
    path, closing = close_stream(finished, solver.intrinsics, sequence, config)
    reconstruction = solver.collect(path)
    write_result(RunFolder(run_dir), reconstruction)
    seconds["total"] = earlier + time.perf_counter() - began
    doubts = found_focal_warnings(sequence, reconstruction.intrinsics[:2], config.geometric_depth.usual_focal)
    doubts += scene_warnings(
        reconstruction.intrinsics, reconstruction.world_T_cam, reconstruction.landmarks,
        intrinsics_covariance=reconstruction.intrinsics_covariance, depth_parallax=sequence.depth_parallax,
    )  # fmt: skip
    facts = []
    if sequence.intrinsics_are_guessed:
        ended = f"and ended at {reconstruction.intrinsics[0]:.0f} px"
        facts.append(f"{started_from_a_guess(sequence.intrinsics)}, {ended}")
    if closing is not None:
        seconds["loops"], facts = closing.seconds, [*facts, *closing.facts()]
        doubts += closing.warnings()
    counts = dict(Counter(frame.status.value for frame in finished.frames()))
    return StreamSummary(sequence.name, sequence.num_frames, first, counts, seconds, peak_memory_mb(), doubts, facts)


def _tracks(sequence: Sequence, frame: int) -> FrameTracks | None:
    tracks = sequence.tracks
    if tracks is None:
        return None
    seen = np.flatnonzero(tracks.visible[:, frame])
    return FrameTracks(seen.astype(np.int64), tracks.uv[seen, frame].astype(np.float64))
