"""The steps of a run as functions from earlier records to a new one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.energy import static_energy
from uni4d_fg.errors import Cancelled, DegenerateProblemError, InputError
from uni4d_fg.geometry.camera import NEAR_PLANE, world_to_camera
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.sequence.model import Sequence
from uni4d_fg.solve.levenberg_marquardt import Hooks
from uni4d_fg.solve.summary import SolveSummary, Termination
from uni4d_fg.stages.bundle_adjustment import (
    BundleAdjustmentResult,
    Freedom,
    StaticNoise,
    adjust_bundle,
)
from uni4d_fg.stages.camera_init import initialize_cameras
from uni4d_fg.stages.local_scale import predict_log_scale
from uni4d_fg.stages.nonrigid import FrozenCameras, NonRigidResult, solve_nonrigid
from uni4d_fg.stages.observations import Observations, observations_of, weigh_by_drift
from uni4d_fg.stages.stage import StageRunner, run_stage
from uni4d_fg.tracks.model import LabelledTracks, TrackLabel

Arrays = Mapping[str, npt.NDArray[Any]]

_MAX_DEPARTURE = 0.15
"""A median |log z - log cue| of moving points above this is warned of."""


def given_poses(sequence: Sequence, config: Config) -> FloatArray | None:
    """Return the poses (T, 4, 4) that the configuration takes from the sequence; None where they are estimated.

    Raises:
        InputError: If the sequence brings none.
    """
    if config.input.poses == "estimate":
        return None
    if sequence.initial_world_T_cam is None:
        raise InputError(
            f"input.poses is '{config.input.poses}' but {sequence.name} brings no poses; add "
            "world_T_cam_init.npy (T, 4, 4) to the sequence or set input.poses to 'estimate'"
        )
    return sequence.initial_world_T_cam


def camera_init_step(
    sequence: Sequence, labelled: LabelledTracks, config: Config, hooks: Hooks, run: StageRunner = run_stage
) -> StageRecord:
    """Stage 1, or the given poses when the config takes them."""
    given = given_poses(sequence, config)
    if given is not None:
        arrays = {"world_T_cam": given, "intrinsics": sequence.intrinsics}
        return StageRecord(arrays, {"solves": [], "facts": [f"poses taken from the sequence ({config.input.poses})"]})
    result = initialize_cameras(
        labelled,
        sequence.intrinsics,
        config.camera_init,
        free_intrinsics=config.input.intrinsics == "free" and config.camera_init.free_intrinsics,
        unsquared=config.energy == "unsquared",
        normalization=config.normalization,
        hooks=hooks,
        run=run,
    )
    _stop_if_cancelled(result.windows)
    facts = [f"{len(result.windows)} windows, {sum(len(w.iterations) for w in result.windows)} iterations in all"]
    summary: dict[str, Any] = {
        "solves": [solve_dict(w) for w in result.windows],
        "facts": facts,
        "bridged_frames": list(result.bridged_frames),
    }
    if result.bridged_frames:
        summary["warnings"] = [
            f"{len(result.bridged_frames)} frame(s) share too few static tracks with those before and start from "
            f"constant velocity: {_listed(result.bridged_frames)}"
        ]
    return StageRecord({"world_T_cam": result.world_T_cam, "intrinsics": result.intrinsics}, summary)


def bundle_adjustment_step(
    sequence: Sequence,
    labelled: LabelledTracks,
    cameras: Arrays,
    config: Config,
    hooks: Hooks,
    run: StageRunner = run_stage,
) -> StageRecord:
    """Stage 2; with fixed poses and no static track the given cameras are kept as they are."""
    stage = config.bundle_adjustment
    observations = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
    if config.energy == "map":
        observations = weigh_by_drift(observations, labelled.tracks.query_frame, stage.drift_frames)
    fixed = config.input.poses == "fixed"
    try:
        result = adjust_bundle(
            observations,
            cameras["world_T_cam"],
            cameras["intrinsics"],
            sequence.intrinsics,
            stage,
            Freedom(poses=not fixed, intrinsics=config.input.intrinsics == "free"),
            unsquared=config.energy == "unsquared",
            normalization=config.normalization,
            hooks=hooks,
            run=run,
        )
    except DegenerateProblemError as reason:
        if not fixed:
            raise
        return _without_landmarks(cameras, config, str(reason))
    _stop_if_cancelled(result.solves)
    return StageRecord(_bundle_arrays(result), _bundle_summary(sequence, result, config))


def _bundle_arrays(result: BundleAdjustmentResult) -> dict[str, npt.NDArray[Any]]:
    return {
        "world_T_cam": result.world_T_cam,
        "intrinsics": result.intrinsics,
        "log_scale": result.log_scale,
        "landmarks": result.landmarks,
        "landmark_track": result.landmark_track,
        "landmark_error": result.landmark_error,
        "pose_covariance": result.pose_covariance,
        "intrinsics_covariance": result.intrinsics_covariance,
        "noise": np.array([result.noise.reprojection_sigma_px, result.noise.depth_sigma]),
    }


def _bundle_summary(sequence: Sequence, result: BundleAdjustmentResult, config: Config) -> dict[str, Any]:
    solves = [solve_dict(s) for s in result.solves]
    summary = bundle_summary(sequence, _bundle_arrays(result), len(result.observations), result.dropped, solves)
    summary["exact_energy"] = static_energy(
        result.world_T_cam, result.intrinsics, result.landmarks, result.observations, config.normalization
    )
    return summary


def bundle_summary(
    sequence: Sequence, arrays: Arrays, num_observations: int, dropped: dict[str, int], solves: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return what ``summary.json`` says of stage 2, from its record's arrays."""
    (fx, fy), landmarks, first = arrays["intrinsics"][:2], arrays["landmarks"], arrays["world_T_cam"][0, :3, 3]
    pixel, relative = arrays["noise"]
    facts = [
        f"{len(landmarks)} landmarks, {num_observations} observations, "
        f"fx {fx:.1f} fy {fy:.1f} px, noise {pixel:.2f} px, depth {100 * relative:.1f} %"
    ]
    warnings = []
    change = float(np.abs(arrays["intrinsics"][:2] / sequence.intrinsics[:2] - 1.0).max())
    if change > 0.15:
        warnings.append(f"the focal lengths moved by {100 * change:.0f} % from the given ones")
    baseline = np.linalg.norm(arrays["world_T_cam"][:, :3, 3] - first, axis=1).max()
    depth = float(np.median(np.linalg.norm(landmarks - first, axis=1)))
    if baseline < 0.01 * depth:
        warnings.append(
            f"the camera moves by only {100 * baseline / depth:.2f} % of the scene's depth: "
            "depth comes from the cue alone, and the focal length is poorly determined"
        )
    return {"solves": solves, "dropped": dropped, "facts": facts, "warnings": warnings}


def _without_landmarks(cameras: Arrays, config: Config, reason: str) -> StageRecord:
    num_frames = len(cameras["world_T_cam"])
    stage = config.bundle_adjustment
    arrays = {
        "world_T_cam": cameras["world_T_cam"],
        "intrinsics": cameras["intrinsics"],
        "log_scale": np.zeros(num_frames),
        "landmarks": np.zeros((0, 3)),
        "landmark_track": np.zeros(0, dtype=np.int64),
        "landmark_error": np.zeros(0, dtype=np.float32),
        "noise": np.array([stage.reprojection_sigma_px, stage.depth_sigma]),
    }
    warning = f"cameras kept as given, depth scales not estimated, noise not measured ({reason})"
    return StageRecord(arrays, {"solves": [], "warnings": [warning]})


def nonrigid_step(
    labelled: LabelledTracks, scene: Arrays, config: Config, hooks: Hooks, run: StageRunner = run_stage
) -> StageRecord:
    """Stage 3; empty without dynamic tracks."""
    observations, cameras = observations_of(labelled, TrackLabel.DYNAMIC), frozen_cameras(scene)
    observations, cameras, facts = _correct_cue(observations, labelled, cameras, scene, config)
    result = solve_nonrigid(
        observations,
        labelled.instance.astype(np.int64),
        cameras,
        config.nonrigid,
        unsquared=config.energy == "unsquared",
        normalization=config.normalization,
        hooks=hooks,
        run=run,
    )
    solves = [] if result.solve is None else [result.solve]
    _stop_if_cancelled(solves)
    arrays = {
        "points": result.points,
        "observed": result.observed,
        "track": result.track,
        "instance": result.instance,
    }
    facts.append(f"{len(result.track)} trajectories of {len(np.unique(result.instance))} instances")
    summary: dict[str, Any] = {"solves": [solve_dict(s) for s in solves], "dropped": result.dropped, "facts": facts}
    departure = _departure_from_cue(result, observations, cameras)
    if departure > _MAX_DEPARTURE:
        summary["warnings"] = [
            f"the distances of moving points depart from the depth cue by {100 * departure:.0f} % (median): the energy "
            "does not hold them; nonrigid.depth_prior does"
        ]
    return StageRecord(arrays, summary)


def _departure_from_cue(result: NonRigidResult, observations: Observations, cameras: FrozenCameras) -> float:
    """Return the median of |log z - log cue| over the observations of the trajectories; 0 without any."""
    used = observations.select(np.isin(observations.track, result.track) & np.isfinite(observations.depth))
    if len(used) == 0:
        return 0.0
    points = result.points[np.searchsorted(result.track, used.track), used.frame]
    z = world_to_camera(cameras.world_T_cam[used.frame], points)[:, 2]
    ratio = np.log(np.maximum(z, NEAR_PLANE)) - np.log(used.depth) - cameras.log_scale[used.frame]
    return float(np.median(np.abs(ratio)))


def _correct_cue(
    observations: Observations, labelled: LabelledTracks, cameras: FrozenCameras, scene: Arrays, config: Config
) -> tuple[Observations, FrozenCameras, list[str]]:
    """Scale the cue at dynamic observations by what the static scene around them says."""
    if config.energy == "unsquared" or len(observations) == 0 or len(scene["landmarks"]) == 0:
        return observations, cameras, []
    static = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
    static = static.select(np.isin(static.track, scene["landmark_track"]))
    _, row = static.rows()
    z = world_to_camera(cameras.world_T_cam[static.frame], scene["landmarks"][row])[:, 2]
    measured = np.log(np.maximum(z, NEAR_PLANE)) - np.log(static.depth)
    neighbours = config.nonrigid.local_scale_neighbours
    local = predict_log_scale(static, measured, cameras.log_scale, observations, neighbours)
    fact = f"depth cue scaled per {'neighbourhood' if local.is_local else 'frame'}, noise {100 * local.sigma:.1f} %"
    observations = replace(observations, depth=observations.depth * np.exp(local.log_scale))
    noise = replace(cameras.noise, depth_sigma=max(local.sigma, config.bundle_adjustment.min_depth_sigma))
    return observations, replace(cameras, log_scale=np.zeros_like(cameras.log_scale), noise=noise), [fact]


def frozen_cameras(scene: Arrays) -> FrozenCameras:
    """Return what stage 3 takes from a stage 2 record."""
    pixel, relative = scene["noise"].tolist()
    log_scale: FloatArray = scene["log_scale"]
    return FrozenCameras(scene["world_T_cam"], scene["intrinsics"], log_scale, StaticNoise(pixel, relative))


def _stop_if_cancelled(solves: list[SolveSummary]) -> None:
    if any(solve.termination is Termination.CANCELLED for solve in solves):
        raise Cancelled("stopped; finished stages are kept, --resume continues from them")


def _listed(frames: tuple[int, ...]) -> str:
    text = ", ".join(str(f) for f in frames[:10])
    return text + (", ..." if len(frames) > 10 else "")
