"""Cameras from the tracks that do not move: stages 1 and 2 on a thinned set, for masks and not for the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled, DegenerateProblemError
from uni4d_fg.frontend.sequence.frames import no_masks
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.runners import stage_runner
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver


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
        config: Both stages and the minimizer.
        free_intrinsics: Whether the focal lengths move.
        observations_per_frame: Tracks are thinned to about this many observations per frame.
        should_stop: Polled by the solves.

    Raises:
        DegenerateProblemError: If no two frames share enough tracks with depth.
        SolverError: If a solve fails.
        Cancelled: If ``should_stop`` said so.
    """
    hooks = Hooks(should_stop=should_stop) if should_stop is not None else None
    solver = StaticSceneSolver(config, stage_runner(config), hooks, observations_per_frame)
    start = solver.initialize(labelled, intrinsics, free_intrinsics=free_intrinsics)
    _raise_if_cancelled(start.windows)
    try:
        scene = solver.adjust(labelled, start.cameras, intrinsics, Freedom(poses=True, intrinsics=free_intrinsics))
    except DegenerateProblemError:  # Stage 1 stands without landmarks.
        return start.cameras
    _raise_if_cancelled(scene.solves)
    return scene.cameras


def _raise_if_cancelled(solves: list[SolveSummary]) -> None:
    if any(solve.termination is Termination.CANCELLED for solve in solves):
        raise Cancelled("stopped while solving the cameras of the motion masks")
