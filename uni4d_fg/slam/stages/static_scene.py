"""The static scene from labelled tracks: stages 1 and 2, for everyone who needs them.

The batch pipeline runs the two one after the other and keeps each result; windows, calibration and the makers of cues
call :meth:`StaticSceneSolver.solve`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner, run_stage
from uni4d_fg.optim.summary import Termination
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, adjust_bundle
from uni4d_fg.slam.stages.camera_init import CameraInitResult, initialize_cameras
from uni4d_fg.slam.stages.energy import energy_of
from uni4d_fg.slam.stages.merging import FindFragments
from uni4d_fg.slam.stages.observations import Observations, observations_of, weigh_by_drift
from uni4d_fg.slam.stages.scene import Cameras, StaticScene

_FAR_FOCAL = 0.2
"""Change of the log focal length in stage 2 from which it is run again: what a smaller one drops is hardly other."""


@dataclass(frozen=True)
class StaticSceneSolver:
    """Camera initialization and bundle adjustment of static tracks."""

    config: Config
    """Both stages and the energy."""
    run: StageRunner = run_stage
    """What solves each declared stage."""
    hooks: Hooks | None = None
    """Progress and cancellation."""
    observations_per_frame: int | None = None
    """Bundle adjustment takes evenly spread tracks with about this many observations per frame; all when None."""
    find_fragments: FindFragments | None = None
    """Joins tracks that are one point, see :func:`~uni4d_fg.slam.stages.bundle_adjustment.adjust_bundle`."""
    timestamps: FloatArray | None = None
    """(T,) s, for the prior on acceleration; frame numbers when None."""

    def initialize(
        self, labelled: LabelledTracks, intrinsics: FloatArray, *, free_intrinsics: bool
    ) -> CameraInitResult:
        """Run stage 1 from the intrinsics (4,); they move if they may here and in ``camera_init.free_intrinsics``.

        Raises:
            DegenerateProblemError: If no two frames share enough tracks with depth.
            SolverError: If a window cannot be solved.
        """
        return initialize_cameras(
            labelled, intrinsics, self.config.camera_init,
            free_intrinsics=free_intrinsics and self.config.camera_init.free_intrinsics,
            energy=energy_of(self.config), hooks=self.hooks, run=self.run,
        )  # fmt: skip

    def adjust(
        self,
        labelled: LabelledTracks,
        start: Cameras,
        prior_intrinsics: FloatArray,
        freedom: Freedom,
        focal_sigma: float | None = None,
    ) -> StaticScene:
        """Run stage 2 from given cameras.

        Covariances allow for ``focal_sigma``, the standard deviation of the log of focal lengths that are held.

        Raises:
            DegenerateProblemError: If no static track can be lifted, or none survives the outlier rules.
            SolverError: If the system is singular or a cue is not finite.
        """
        observations = self._observations(labelled)

        def adjusted(cameras: Cameras) -> StaticScene:
            return adjust_bundle(
                observations, cameras, prior_intrinsics, self.config.bundle_adjustment, freedom,
                energy_of(self.config), self.hooks, self.run, self.find_fragments, self.timestamps, focal_sigma,
            )  # fmt: skip

        scene = adjusted(start)
        change = np.log(scene.cameras.intrinsics[:2] / start.intrinsics[:2])
        was_cancelled = scene.solves[-1].termination is Termination.CANCELLED
        if not energy_of(self.config).is_likelihood or was_cancelled or np.abs(change).max() <= _FAR_FOCAL:
            return scene
        # The outlier rules judged by a camera that was far off, and what they dropped is not what is wrong.
        again = adjusted(scene.cameras)
        return replace(again, solves=[*scene.solves, *again.solves])

    def solve(
        self,
        labelled: LabelledTracks,
        intrinsics: FloatArray,
        prior_intrinsics: FloatArray,
        *,
        free_intrinsics: bool,
        initial_world_T_cam: FloatArray | None = None,
    ) -> StaticScene:
        """Run both stages; given poses (T, 4, 4) take the place of stage 1.

        Raises:
            DegenerateProblemError: If the cues do not determine the cameras.
            SolverError: If a system is singular or a cue is not finite.
        """
        if initial_world_T_cam is None:
            first = self.initialize(labelled, intrinsics, free_intrinsics=free_intrinsics)
            start, solves = first.cameras, first.windows
        else:
            start, solves = Cameras(initial_world_T_cam, intrinsics, np.zeros(len(initial_world_T_cam))), []
        scene = self.adjust(labelled, start, prior_intrinsics, Freedom(poses=True, intrinsics=free_intrinsics))
        return replace(scene, solves=[*solves, *scene.solves])

    def _observations(self, labelled: LabelledTracks) -> Observations:
        observations = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
        if self.observations_per_frame is not None:
            wanted = self.observations_per_frame * labelled.tracks.num_frames
            if len(observations) > wanted:
                observations = observations.select(observations.thinned(wanted))
        if energy_of(self.config).is_likelihood:
            drift = self.config.bundle_adjustment.drift_frames
            observations = weigh_by_drift(observations, labelled.tracks.query_frame, drift)
        return observations
