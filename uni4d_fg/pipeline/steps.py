"""The steps of a run as functions from earlier records to a new one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, IntArray, rows_by_group
from uni4d_fg.config.models import Config
from uni4d_fg.config.solver import KernelConfig
from uni4d_fg.config.stages import BundleAdjustmentConfig, CameraMotionConfig
from uni4d_fg.counted import counted
from uni4d_fg.errors import Cancelled, DegenerateProblemError, InputError
from uni4d_fg.factors.variable_types import INTRINSICS
from uni4d_fg.frontend.measurements.imu import ImuSamples
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.frontend.sequence.problems import some_of
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry.camera import NEAR_PLANE, seen_from
from uni4d_fg.optim.added_factors import adding_to
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.pipeline.dropped_tracks import dropped_tracks
from uni4d_fg.pipeline.inertial import imu_fact, imu_summary
from uni4d_fg.pipeline.rigid import rigid_objects_part
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.pipeline.warnings import scene_warnings, started_from_a_guess, unmasked_motion_warnings
from uni4d_fg.slam.measurements.imu_start import start_with_imu
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, bundle_adjustment_problem
from uni4d_fg.slam.stages.contradicting_depth import contradicting_frames
from uni4d_fg.slam.stages.depth_spread import depth_spread
from uni4d_fg.slam.stages.energy import Normalization, PaperEnergy, energy_of
from uni4d_fg.slam.stages.local_scale import predict_log_scale
from uni4d_fg.slam.stages.merging import FindFragments
from uni4d_fg.slam.stages.nonrigid import solve_nonrigid
from uni4d_fg.slam.stages.observations import Observations, observations_of
from uni4d_fg.slam.stages.proximal import LiftNoise, lift_noise
from uni4d_fg.slam.stages.scene import Cameras, DynamicScene, StaticNoise, StaticScene
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver

Arrays = Mapping[str, npt.NDArray[Any]]

STOPPED = "stopped; finished stages are kept, --resume continues from them"
_MAX_DEPARTURE = 0.15
"""A median |log z - log cue| of moving points above this is warned of."""
_STRETCHED = 0.03
"""A mean relative error of depth above this, of the focal lengths alone, is told."""


def given_poses(sequence: Video | Sequence, config: Config) -> FloatArray | None:
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
    solver = StaticSceneSolver(config, run, hooks)
    result = solver.initialize(labelled, sequence.intrinsics, free_intrinsics=config.input.intrinsics == "free")
    stop_if_cancelled(result.windows)
    facts = [
        f"{counted(len(result.windows), 'window')}, {sum(len(w.iterations) for w in result.windows)} iterations in all"
    ]
    summary: dict[str, Any] = {
        "solves": [solve_dict(w) for w in result.windows],
        "facts": facts,
        "bridged_frames": list(result.bridged_frames),
    }
    if result.bridged_frames:
        summary["warnings"] = [
            f"{len(result.bridged_frames)} frame(s) share too few static tracks with those before and start from "
            f"constant velocity: {some_of(result.bridged_frames, 10)}"
        ]
    cameras = result.cameras
    arrays = {"world_T_cam": cameras.world_T_cam, "intrinsics": cameras.intrinsics}
    if energy_of(config).is_likelihood:
        static = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
        arrays["depth_spread"] = np.array(depth_spread(static, cameras))
    return StageRecord(arrays, summary)


def bundle_adjustment_step(
    sequence: Sequence,
    labelled: LabelledTracks,
    cameras: Arrays,
    config: Config,
    hooks: Hooks,
    run: StageRunner = run_stage,
    imu: ImuSamples | None = None,
    find_fragments: FindFragments | None = None,
) -> StageRecord:
    """Stage 2; with fixed poses and no static track the given cameras are kept as they are.

    With an IMU it is solved twice: without it, and from there with it. With ``find_fragments`` tracks of one point are
    one landmark in the last solve.
    """
    fixed = config.input.poses == "fixed"
    start = Cameras(cameras["world_T_cam"], cameras["intrinsics"], np.zeros(len(cameras["world_T_cam"])))
    freedom = Freedom(poses=not fixed, intrinsics=config.input.intrinsics == "free")
    if imu is not None:
        return _with_imu(sequence, labelled, start, freedom, config, hooks, run, imu, find_fragments)
    try:
        solver = StaticSceneSolver(config, run, hooks, find_fragments=find_fragments, timestamps=sequence.timestamps)
        scene = solver.adjust(labelled, start, sequence.intrinsics, freedom, sequence.focal_sigma)
    except DegenerateProblemError as reason:
        if not fixed:
            raise
        return _without_landmarks(cameras, config, str(reason))
    stop_if_cancelled(scene.solves)
    return StageRecord(scene_arrays(scene), _scene_summary(sequence, labelled, scene, config))


def _with_imu(
    sequence: Sequence,
    labelled: LabelledTracks,
    start: Cameras,
    freedom: Freedom,
    config: Config,
    hooks: Hooks,
    run: StageRunner,
    imu: ImuSamples,
    find_fragments: FindFragments | None,
) -> StageRecord:
    prior = sequence.intrinsics
    first = start_with_imu(labelled, start, prior, freedom, sequence.timestamps, imu, config, hooks, run)
    stop_if_cancelled(first.solves)
    adding = adding_to(run, [first.source])
    solver = StaticSceneSolver(config, adding, hooks, find_fragments=find_fragments, timestamps=sequence.timestamps)
    scene = solver.adjust(labelled, first.cameras, prior, freedom, sequence.focal_sigma)
    stop_if_cancelled(scene.solves)
    summary = _scene_summary(sequence, labelled, replace(scene, solves=[*first.solves, *scene.solves]), config)
    summary["imu"] = imu_summary(first, adding)
    summary["facts"].append(imu_fact(summary["imu"]))
    return StageRecord(scene_arrays(scene), summary)


def scene_arrays(scene: StaticScene) -> dict[str, npt.NDArray[Any]]:
    """Return a static scene as a record holds it."""
    return {
        "world_T_cam": scene.cameras.world_T_cam,
        "intrinsics": scene.cameras.intrinsics,
        "log_scale": scene.cameras.log_scale,
        "landmarks": scene.landmarks,
        "landmark_track": scene.landmark_track,
        "landmark_error": scene.landmark_error,
        "pose_covariance": scene.pose_covariance,
        "intrinsics_covariance": scene.intrinsics_covariance,
        "noise": scene.noise.array(),
        "focal_depth_error": np.array(scene.focal_depth_error),
        **({} if scene.acceleration is None else scene.acceleration.arrays()),
    }


def _scene_summary(sequence: Sequence, labelled: LabelledTracks, scene: StaticScene, config: Config) -> dict[str, Any]:
    solves = [solve_dict(s) for s in scene.solves]
    summary = bundle_summary(sequence, labelled, scene_arrays(scene), len(scene.observations), scene.dropped, solves)
    if scene.joined:
        summary["joined_tracks"] = scene.joined
        summary["facts"].append(f"{scene.joined} tracks joined to earlier ones of the same point")
    if scene.acceleration is not None:
        summary["facts"] += scene.acceleration.facts("m" if sequence.depth_is_metric else "units")
    summary["exact_energy"] = paper_energy(scene, config.normalization)
    return summary


def paper_energy(scene: StaticScene, normalization: Normalization) -> dict[str, float]:
    """Return the paper's E_BA and E_cam of a static scene, unsmoothed: a yardstick for every solver and energy."""
    config = BundleAdjustmentConfig(
        depth_prior=False, camera_motion=CameraMotionConfig(), reprojection_kernel=KernelConfig(kind="norm")
    )
    state, held = scene.state(), Freedom(poses=False, intrinsics=False)
    problem = bundle_adjustment_problem(
        state, scene.observations, StaticNoise(1.0, 1.0), config, state[INTRINSICS], held, PaperEnergy(normalization)
    )
    return problem.energies(state, exact=True)


def bundle_summary(
    sequence: Sequence,
    labelled: LabelledTracks,
    arrays: Arrays,
    num_observations: int,
    dropped: dict[str, int],
    solves: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return what ``summary.json`` says of stage 2, from its record's arrays."""
    (fx, fy), landmarks = arrays["intrinsics"][:2], arrays["landmarks"]
    noise = StaticNoise.of_array(arrays["noise"])
    facts = [
        f"{len(landmarks)} landmarks, {num_observations} observations, "
        f"fx {fx:.1f} fy {fy:.1f} px, noise {noise.reprojection_sigma_px:.2f} px, "
        f"depth {100 * noise.depth_sigma:.1f} %"
    ]
    stretched = float(arrays.get("focal_depth_error", 0.0))
    if stretched > _STRETCHED:
        facts.append(
            f"depth hangs on the focal length, which is known to {100 * (sequence.focal_sigma or 0.0):.1f} %: "
            f"so much more of it would change depth by {100 * stretched:.0f} % in the mean, scale apart"
        )
    if sequence.intrinsics_are_guessed:
        facts.append(started_from_a_guess(sequence.intrinsics))
    # How far focal lengths moved, a lens or a zoom among what moved them, is known at the end of the run.
    warnings = scene_warnings(
        arrays["intrinsics"], arrays["world_T_cam"], landmarks, arrays["pose_covariance"],
        arrays["intrinsics_covariance"], focal_was_doubted=sequence.focal_sigma is not None,
        depth_parallax=sequence.depth_parallax,
    )  # fmt: skip
    warnings += unmasked_motion_warnings(
        labelled,
        arrays["landmark_track"],
        arrays["landmark_error"],
        noise.reprojection_sigma_px,
        max(sequence.image_size),
        lambda: dropped_tracks(labelled, arrays),
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
        "noise": StaticNoise(stage.reprojection_sigma_px, stage.depth_sigma).array(),
    }
    warning = f"cameras kept as given, depth scales not estimated, noise not measured ({reason})"
    return StageRecord(arrays, {"solves": [], "warnings": [warning]})


def nonrigid_step(
    labelled: LabelledTracks,
    scene: Arrays,
    config: Config,
    hooks: Hooks,
    run: StageRunner = run_stage,
    timestamps: FloatArray | None = None,
) -> StageRecord:
    """Stage 3; empty without dynamic tracks. With ``timestamps`` (T,), s, rigid objects too if the config asks."""
    observations = observations_of(labelled, TrackLabel.DYNAMIC)
    cameras, noise = frozen_cameras(scene)
    observations, cameras, noise, facts = correct_cue(observations, labelled, cameras, noise, scene, config)
    held, said = _noise_of_lift(labelled, cameras, scene, config)
    facts += said
    result = solve_nonrigid(
        observations,
        labelled.instance.astype(np.int64),
        cameras,
        noise,
        config.nonrigid,
        energy_of(config),
        hooks=hooks,
        run=run,
        lift_noise=held,
    )
    solves = [] if result.solve is None else [result.solve]
    stop_if_cancelled(solves)
    arrays = {
        "points": result.points,
        "observed": result.observed,
        "track": result.track,
        "instance": result.instance,
    }
    facts.append(
        f"{counted(len(result.track), 'trajectory', 'trajectories')} of "
        f"{counted(len(np.unique(result.instance)), 'instance')}"
    )
    summary: dict[str, Any] = {"solves": [solve_dict(s) for s in solves], "dropped": result.dropped, "facts": facts}
    if config.rigid_objects.enabled and timestamps is not None:
        objects, part, found = rigid_objects_part(
            result, observations, labelled, cameras, noise, timestamps, config, hooks, run
        )
        if hooks.should_stop is not None and hooks.should_stop():
            raise Cancelled(STOPPED)
        arrays, summary["rigid_objects"] = {**arrays, **objects}, part
        facts += found
    departure = _departure_from_cue(result, observations, cameras)
    if departure > _MAX_DEPARTURE:
        summary["warnings"] = [
            f"the distances of moving points depart from the depth cue by {100 * departure:.0f} % (median): the energy "
            "does not hold them; nonrigid.depth_prior does"
        ]
    return StageRecord(arrays, summary)


def _departure_from_cue(result: DynamicScene, observations: Observations, cameras: Cameras) -> float:
    """Return the median of |log z - log cue| over the observations of the trajectories; 0 without any."""
    used = observations.select(np.isin(observations.track, result.track) & np.isfinite(observations.depth))
    if len(used) == 0:
        return 0.0
    points = result.points[np.searchsorted(result.track, used.track), used.frame]
    z = seen_from(cameras.world_T_cam, used.frame, points)[:, 2]
    ratio = np.log(np.maximum(z, NEAR_PLANE)) - np.log(used.depth) - cameras.log_scale[used.frame]
    return float(np.median(np.abs(ratio)))


def correct_cue(
    observations: Observations,
    labelled: LabelledTracks,
    cameras: Cameras,
    noise: StaticNoise,
    scene: Arrays,
    config: Config,
) -> tuple[Observations, Cameras, StaticNoise, list[str]]:
    """Scale the cue at dynamic observations by what the static scene around them says."""
    if not energy_of(config).is_likelihood or len(observations) == 0 or len(scene["landmarks"]) == 0:
        return observations, cameras, noise, []
    static, row = landmark_observations(labelled, scene)
    z = seen_from(cameras.world_T_cam, static.frame, scene["landmarks"][row])[:, 2]
    measured = np.log(np.maximum(z, NEAR_PLANE)) - np.log(static.depth)
    # A constant cue where something moves would pull it away, and smoothness the frames beside with it.
    of_frames = rows_by_group(static.frame, len(cameras.log_scale))
    seen = [(static.depth[rows].astype(np.float64), measured[rows]) for rows in of_frames]
    broken = np.isin(observations.frame, contradicting_frames(seen, config.fusion))
    observations = replace(observations, depth=np.where(broken, np.nan, observations.depth))
    neighbors, samples = config.nonrigid.local_scale_neighbors, config.nonrigid.local_scale_samples
    local = predict_log_scale(static, measured, cameras.log_scale, observations, neighbors, samples)
    fact = f"depth cue scaled per {'neighborhood' if local.is_local else 'frame'}, noise {100 * local.sigma:.1f} %"
    observations = replace(observations, depth=observations.depth * np.exp(local.log_scale))
    noise = replace(noise, depth_sigma=max(local.sigma, config.bundle_adjustment.min_depth_sigma))
    return observations, replace(cameras, log_scale=np.zeros_like(cameras.log_scale)), noise, [fact]


def _noise_of_lift(
    labelled: LabelledTracks, cameras: Cameras, scene: Arrays, config: Config
) -> tuple[LiftNoise | None, list[str]]:
    """Measure what the proximal term of the paper's energy is in units of, if it is asked for."""
    if config.nonrigid.proximal_weight == 0 or len(scene["landmarks"]) == 0:
        return None, []
    static, row = landmark_observations(labelled, scene)
    noise = lift_noise(static, scene["landmarks"][row], cameras)
    if noise is None:
        return None, []
    fact = f"moving points held near their lift, noise {100 * noise.sigma:.1f} %"
    return replace(noise, sigma=max(noise.sigma, config.bundle_adjustment.min_depth_sigma)), [fact]


def landmark_observations(labelled: LabelledTracks, scene: Arrays) -> tuple[Observations, IntArray]:
    """Return all observations of the landmarks of a stage 2 record, and the landmark of each."""
    static = observations_of(labelled, TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
    static = static.select(np.isin(static.track, scene["landmark_track"]))
    return static, static.rows()[1]


def frozen_cameras(scene: Arrays) -> tuple[Cameras, StaticNoise]:
    """Return what stage 3 takes from a stage 2 record."""
    log_scale: FloatArray = scene["log_scale"]
    return Cameras(scene["world_T_cam"], scene["intrinsics"], log_scale), StaticNoise.of_array(scene["noise"])


def stop_if_cancelled(solves: list[SolveSummary], message: str = STOPPED) -> None:
    """Raise what ends a run in which a solve was cancelled."""
    if any(solve.termination is Termination.CANCELLED for solve in solves):
        raise Cancelled(message)
