"""Cameras from the tracks that do not move: stages 1 and 2 on a thinned set, for masks and not for the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.track_motion import Cameras
from uni4d_fg.errors import Cancelled, DegenerateProblemError
from uni4d_fg.pipeline.solver import stage_runner
from uni4d_fg.sequence.frames import no_masks
from uni4d_fg.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.solve.levenberg_marquardt import Hooks
from uni4d_fg.solve.summary import SolveSummary, Termination
from uni4d_fg.stages.bundle_adjustment import Freedom, adjust_bundle
from uni4d_fg.stages.camera_init import initialize_cameras
from uni4d_fg.stages.observations import observations_of, weigh_by_drift
from uni4d_fg.tracks.labels import label_tracks
from uni4d_fg.tracks.model import LabelledTracks, TrackLabel, Tracks


@dataclass(frozen=True)
class StaticTracks:
    """All tracks of a video with their depth, called static until they are found to move."""

    labelled: LabelledTracks

    @classmethod
    def of(
        cls, video: Video, depths: FrameSource[Float32Array], tracks: Tracks, intrinsics: FloatArray, config: Config
    ) -> StaticTracks:
        """Sample the depth of every observation.

        Raises:
            InputError: If tracks or depth do not fit the images.
        """
        sequence = Sequence(
            name=video.name,
            images=video.images,
            depths=depths,
            masks=no_masks(video.image_size, video.num_frames),
            intrinsics=intrinsics,
            image_size=video.image_size,
            timestamps=video.timestamps,
        )
        return cls(label_tracks(tracks, sequence, config.labels, config.input))


def solve_cameras(
    labelled: LabelledTracks,
    intrinsics: FloatArray,
    config: Config,
    *,
    free_intrinsics: bool,
    observations_per_frame: int,
    should_stop: Callable[[], bool] | None = None,
) -> Cameras:
    """Solve stage 1 and stage 2 from static tracks.

    Args:
        labelled: Tracks; those that are STATIC or SHORT_STATIC count.
        intrinsics: (4,) px, known or to start from.
        config: Both stages and the minimiser.
        free_intrinsics: Whether the focal lengths move.
        observations_per_frame: Tracks are thinned to about this many observations per frame.
        should_stop: Polled by the solves.

    Raises:
        DegenerateProblemError: If no two frames share enough tracks with depth.
        SolverError: If a solve fails.
        Cancelled: If ``should_stop`` said so.
    """
    run = stage_runner(config)
    hooks = Hooks(should_stop=should_stop) if should_stop is not None else None
    unsquared = config.energy == "unsquared"
    start = initialize_cameras(
        labelled,
        intrinsics,
        config.camera_init,
        free_intrinsics=free_intrinsics and config.camera_init.free_intrinsics,
        unsquared=unsquared,
        normalization=config.normalization,
        hooks=hooks,
        run=run,
    )
    _raise_if_cancelled(start.windows)
    no_scale = np.zeros(labelled.tracks.num_frames)
    observations = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
    wanted = observations_per_frame * labelled.tracks.num_frames
    if len(observations) > wanted:
        chosen, _ = observations.rows()
        chosen = chosen[np.linspace(0, len(chosen) - 1, max(1, len(chosen) * wanted // len(observations))).astype(int)]
        observations = observations.select(np.isin(observations.track, chosen))
    observations = weigh_by_drift(observations, labelled.tracks.query_frame, config.bundle_adjustment.drift_frames)
    try:
        result = adjust_bundle(
            observations,
            start.world_T_cam,
            start.intrinsics,
            intrinsics,
            config.bundle_adjustment,
            Freedom(poses=True, intrinsics=free_intrinsics),
            unsquared=unsquared,
            normalization=config.normalization,
            hooks=hooks,
            run=run,
        )
    except DegenerateProblemError:  # Stage 1 stands without landmarks.
        return Cameras(start.world_T_cam, start.intrinsics, no_scale)
    _raise_if_cancelled(result.solves)
    return Cameras(result.world_T_cam, result.intrinsics, result.log_scale)


def _raise_if_cancelled(solves: list[SolveSummary]) -> None:
    if any(solve.termination is Termination.CANCELLED for solve in solves):
        raise Cancelled("stopped while solving the cameras of the motion masks")
