"""The joint energy in a run: after stage 3, into a record that takes the place of those of stages 2 and 3."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner, run_stage
from uni4d_fg.pipeline.steps import correct_cue, frozen_cameras, landmark_observations, scene_arrays, stop_if_cancelled
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.slam.reconstruction import OBJECT_ARRAYS
from uni4d_fg.slam.stages.acceleration import AccelerationPrior
from uni4d_fg.slam.stages.bundle_adjustment import Freedom
from uni4d_fg.slam.stages.energy import energy_of
from uni4d_fg.slam.stages.joint import MovingCues, solve_joint
from uni4d_fg.slam.stages.observations import Observations, observations_of, weigh_by_drift
from uni4d_fg.slam.stages.scene import DynamicScene, StaticScene, unknown_covariances
from uni4d_fg.slam.stages.weights import weigh_by_residuals

Arrays = Mapping[str, npt.NDArray[Any]]
NOT_IN_WINDOWS = "the joint energy is not solved in windows"
WITHOUT_IMU = "the joint energy has no part for inertial measurements: its cameras are those of the images alone"


def joint_step(
    sequence: Sequence,
    labelled: LabelledTracks,
    scene: Arrays,
    motion: Arrays,
    config: Config,
    hooks: Hooks,
    run: StageRunner = run_stage,
) -> StageRecord:
    """Solve the joint energy from the records of stages 2 and 3; without landmarks or moving points they stay.

    Returns:
        The arrays of both records with the new values; rigid objects are those of stage 3.

    Raises:
        Cancelled: If the hooks said so.
        SolverError: If the system is singular.
    """
    if len(motion["track"]) == 0 or len(scene["landmarks"]) == 0:
        missing = "moving points" if len(motion["track"]) == 0 else "static landmarks"
        return StageRecord({**scene, **motion}, {"solves": [], "facts": [f"nothing to do without {missing}"]})
    freedom = Freedom(poses=config.input.poses != "fixed", intrinsics=config.input.intrinsics == "free")
    static, moving = solve_joint(
        static_scene(labelled, scene, config),
        DynamicScene(motion["points"], motion["observed"], motion["track"], motion["instance"]),
        moving_cues(labelled, scene, config),
        config, sequence.intrinsics, freedom, hooks, run,
    )  # fmt: skip
    stop_if_cancelled(static.solves)
    turned, shifted = _camera_change(scene["world_T_cam"], static.cameras.world_T_cam)
    solve = static.solves[0]
    facts = [
        f"cameras moved by {100 * shifted:.2f} cm and {turned:.3f} degrees (median), moving points by "
        f"{100 * _point_change(motion['points'], moving.points):.2f} cm",
    ]
    kept = {name: motion[name] for name in OBJECT_ARRAYS if name in motion}
    arrays = {
        **scene_arrays(static), **kept,
        "points": moving.points, "observed": moving.observed, "track": moving.track, "instance": moving.instance,
    }  # fmt: skip
    summary: dict[str, Any] = {
        "solves": [solve_dict(solve) for solve in (*static.solves[1:], solve)],
        "dropped": static.dropped,
        "facts": facts,
    }
    return StageRecord(arrays, summary)


def static_scene(labelled: LabelledTracks, scene: Arrays, config: Config) -> StaticScene:
    """Return the end of stage 2 from its record, with all observations of the landmarks it kept.

    Tracks of one point, which were one landmark in stage 2, are a landmark each.
    """
    observations, _ = landmark_observations(labelled, scene)
    cameras, noise = frozen_cameras(scene)
    if energy_of(config).is_likelihood:
        drift = config.bundle_adjustment.drift_frames
        observations = weigh_by_drift(observations, labelled.tracks.query_frame, drift)
        state = cameras.state(scene["landmarks"], scene["landmark_track"])
        observations = weigh_by_residuals(state, observations, config.bundle_adjustment)
    unknown = unknown_covariances(len(cameras.world_T_cam))
    return StaticScene(
        cameras, scene["landmarks"], scene["landmark_track"], observations, noise, scene["landmark_error"],
        scene.get("pose_covariance", unknown[0]), scene.get("intrinsics_covariance", unknown[1]),
        acceleration=AccelerationPrior.of_arrays(scene),
    )  # fmt: skip


def moving_cues(labelled: LabelledTracks, scene: Arrays, config: Config) -> MovingCues:
    """Return what stage 3 was solved from; its correction of the depth cue is kept, relative to the frames' scales."""
    cameras, noise = frozen_cameras(scene)
    observations: Observations = observations_of(labelled, TrackLabel.DYNAMIC)
    observations, corrected, noise, _ = correct_cue(observations, labelled, cameras, noise, scene, config)
    shift = (corrected.log_scale - cameras.log_scale)[observations.frame]
    return MovingCues(replace(observations, depth=observations.depth * np.exp(shift)), noise)


def _camera_change(before: npt.NDArray[Any], after: npt.NDArray[Any]) -> tuple[float, float]:
    """Return the median rotation, degrees, and the median shift, m."""
    trace = np.einsum("tij,tij->t", before[:, :3, :3], after[:, :3, :3])
    angle = np.degrees(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))
    return float(np.median(angle)), float(np.median(np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)))


def _point_change(before: npt.NDArray[Any], after: npt.NDArray[Any]) -> float:
    return float(np.nanmedian(np.linalg.norm(after - before, axis=2)))
