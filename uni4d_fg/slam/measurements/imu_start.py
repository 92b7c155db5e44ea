"""Where bundle adjustment with an IMU starts: a visual bundle adjustment, brought to meters and joined by the IMU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.measurements.imu import ImuSamples
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.measurements.imu_alignment import VisualInertialAlignment, align_with_imu, visible_parts
from uni4d_fg.slam.measurements.imu_source import ImuSource
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver


@dataclass(frozen=True)
class InertialStart:
    """What bundle adjustment with an IMU starts from."""

    cameras: Cameras
    """Metric."""
    source: ImuSource
    alignment: VisualInertialAlignment
    part: IntArray
    """(T,) part of the video each frame belongs to, from tracks alone; -1 for frames that see nothing."""
    solves: list[SolveSummary]
    """Of the visual bundle adjustment."""


def start_with_imu(
    labelled: LabelledTracks,
    start: Cameras,
    prior_intrinsics: FloatArray,
    freedom: Freedom,
    frame_times: FloatArray,
    samples: ImuSamples,
    config: Config,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> InertialStart:
    """Solve bundle adjustment without the IMU, and align the two.

    Args:
        labelled: All tracks.
        start: Cameras of stage 1.
        prior_intrinsics: (4,) the sequence's own intrinsics.
        freedom: What bundle adjustment may move.
        frame_times: (T,) s.
        samples: Of the IMU.
        config: Of the run.
        hooks: Progress and cancellation.
        run: What solves each declared stage.

    Raises:
        InputError: If the samples do not cover the frames.
        DegenerateProblemError: If the cues do not determine the cameras, or the motion does not determine the scale.
        SolverError: If a stage cannot be solved.
    """
    samples.check_covers(frame_times)
    kept = config.bundle_adjustment.model_copy(update={"structure": "keep"})
    visual = config.model_copy(update={"bundle_adjustment": kept})
    solver = StaticSceneSolver(visual, run, hooks, timestamps=frame_times)
    scene = solver.adjust(labelled, start, prior_intrinsics, freedom)
    seen, count = scene.observations, len(frame_times)
    part = visible_parts(seen.track, seen.frame, count, config.imu.min_shared_tracks)
    aligned = align_with_imu(scene.cameras.world_T_cam, part, frame_times, samples, config.imu)
    log_scale = np.where(part >= 0, scene.cameras.log_scale, 0.0) + np.log(aligned.scale)
    cameras = Cameras(aligned.world_T_cam, scene.cameras.intrinsics, log_scale)
    source = ImuSource.of(samples, frame_times, aligned, config.imu)
    return InertialStart(cameras, source, aligned, part, scene.solves)
