"""Stage 2: bundle adjustment of poses, intrinsics, depth scales and landmarks.

Landmarks start at the mean lift of their depth cues. With the MAP energy a first solve uses the configured
sigmas and believes the depth cue more closely; observations that disagree are dropped, the noise of reprojection (of
each track) and of depth is measured on what stays, and a second solve uses it; in that one, tracks that are fragments
of one point share a landmark. Frame 0's pose is the gauge; the depth prior (or, without it, the distance of the two
farthest cameras) holds the scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.allocation import LARGE, return_free_memory
from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import NEAR_DAMPING, KernelConfig, SolverConfig
from uni4d_fg.config.stages import AccelerationConfig, BundleAdjustmentConfig, CameraMotionConfig
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.priors import scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.added_factors import HOLDS_SCALE, joined_by
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.stage import Stage, StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.stages.acceleration import AccelerationPrior, estimate_prior, starting_prior
from uni4d_fg.slam.stages.energy import MAP, Energy
from uni4d_fg.slam.stages.focal_depth_error import focal_depth_error
from uni4d_fg.slam.stages.merging import FindFragments, MergedTracks, merge_tracks
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise, StaticScene, unknown_covariances
from uni4d_fg.slam.stages.static_covariance import considered_focal_lengths, static_marginals, track_cells
from uni4d_fg.slam.stages.static_outliers import drop_outliers, landmark_errors, measure_noise, spatial_inliers
from uni4d_fg.slam.stages.structure import (
    depth_prior_terms,
    further_landmarks,
    joined_landmarks,
    liftable,
    refine_structure,
    relift_structure,
    reprojection_term,
)
from uni4d_fg.slam.stages.terms import camera_motion_terms, intrinsics_priors
from uni4d_fg.slam.stages.weights import weigh_by_residuals

_FIRST_DEPTH_KERNEL = KernelConfig(kind="cauchy", threshold=1.0)
"""Of the first solve: a track beside an edge moves with what is in front and may have the depth behind, and among small
things half of all do. A kernel that holds on to them bends the cameras."""


@dataclass(frozen=True)
class Freedom:
    """What stage 2 may move besides landmarks."""

    poses: bool
    intrinsics: bool


def without_camera_motion(config: BundleAdjustmentConfig) -> BundleAdjustmentConfig:
    """Return stage 2 without E_cam, which is made for consecutive frames."""
    still = CameraMotionConfig(rotation_weight=0.0, translation_weight=0.0)
    free = AccelerationConfig(linear=None, angular=None)
    return config.model_copy(update={"camera_motion": still, "acceleration": free})


def without_depth_prior(config: BundleAdjustmentConfig) -> BundleAdjustmentConfig:
    """Return stage 2 in which the depth cue says nothing of the cameras."""
    return config.model_copy(update={"depth_prior": False})


def bundle_adjustment_problem(
    state: State,
    observations: Observations,
    noise: StaticNoise,
    config: BundleAdjustmentConfig,
    prior_intrinsics: FloatArray,
    freedom: Freedom,
    energy: Energy = MAP,
    camera_motion: Sequence[FactorBatch] | None = None,
    acceleration: AccelerationPrior | None = None,
) -> Problem:
    """Put bundle adjustment together.

    Args:
        state: Poses (T), intrinsics, log-scales and landmarks (named by track).
        observations: Observations of exactly those landmarks.
        noise: Sigmas of the MAP energy.
        config: Stage 2.
        prior_intrinsics: (1, 4) center of the intrinsics' prior.
        freedom: What is free besides landmarks and log-scales.
        energy: Weighs the terms.
        camera_motion: E_cam, where frames do not follow each other; over all frames when None.
        acceleration: Prior on the cameras' acceleration; none when None.
    """
    num_frames = len(state[POSE])
    _, row = observations.rows()
    problem = Problem.over(state).eliminate(LANDMARK)
    problem.add(reprojection_term(observations, row, noise.reprojection_sigma_px, num_frames, config, energy))
    if camera_motion is None:
        camera_motion = camera_motion_terms(np.arange(num_frames), config.camera_motion, energy)
    problem.add(camera_motion)
    if acceleration is not None and energy.is_likelihood:
        problem.add(acceleration.terms())
    problem.fix(POSE, rows=[0] if freedom.poses else None)
    if not freedom.intrinsics:
        problem.fix(INTRINSICS)
    else:
        if not config.free_principal_point:
            problem.fix(INTRINSICS, entries=[2, 3])
        if energy.is_likelihood:
            problem.add(intrinsics_priors(prior_intrinsics, config.focal_prior_fraction, config.aspect_prior_sigma))
    if config.depth_prior:
        per_track = len(observations) / max(len(state[LANDMARK]), 1)
        sigma = noise.effective_depth_sigma(per_track) * config.depth_sigma_factor
        problem.add(depth_prior_terms(observations, row, sigma, num_frames, config))
    else:
        problem.fix(LOG_SCALE)
        if freedom.poses:
            problem.add(scale_anchors(state[POSE], config.scale_anchor_sigma))
    return problem


def scale_anchors(world_T_cam: FloatArray, sigma_m: float) -> list[FactorBatch]:
    """Hold the distance between frame 0 and the camera farthest from it; empty for a camera at rest."""
    distance = np.linalg.norm(world_T_cam[:, :3, 3] - world_T_cam[0, :3, 3], axis=1)
    farthest = int(np.argmax(distance))
    if distance[farthest] < 1e-6:
        return []
    return [scale_anchor(0, farthest, distance=distance[[farthest]], sigma=sigma_m)]


def adjust_bundle(
    observations: Observations,
    start: Cameras,
    prior_intrinsics: FloatArray,
    config: BundleAdjustmentConfig,
    freedom: Freedom,
    energy: Energy = MAP,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
    find_fragments: FindFragments | None = None,
    timestamps: FloatArray | None = None,
    focal_sigma: float | None = None,
) -> StaticScene:
    """Run stage 2 from the poses and intrinsics of stage 1.

    Args:
        observations: Trusted observations of static tracks.
        start: Starting cameras, with the log-scales that lift the depth cue.
        prior_intrinsics: (4,) the sequence's own intrinsics.
        config: Stage 2.
        freedom: Whether poses and intrinsics move.
        energy: Weighs the terms.
        hooks: Progress and cancellation.
        run: What solves each declared stage.
        find_fragments: Finds tracks that are one point, before the second solve; None leaves every track its own.
        timestamps: (T,) s, for the prior on acceleration; frame numbers when None.
        focal_sigma: Standard deviation of the log of focal lengths that are held, which the covariances allow for.

    Raises:
        DegenerateProblemError: If no static track can be lifted, or none survives the outlier rules.
        SolverError: If the system is singular or a cue is not finite.
    """
    dropped: dict[str, int] = {}
    observations, landmarks = liftable(observations, start, config, dropped)
    if len(observations) == 0:
        raise DegenerateProblemError(
            "bundle adjustment: no static track has depth in any frame and is seen in "
            f"{config.min_observations} frames. Check masks and depth with 'uni4d-fg validate'."
        )
    others: Observations | None = None
    if energy.is_likelihood and config.structure == "refine" and len(observations) > config.max_camera_observations:
        observations, others, rows = observations.parted(config.max_camera_observations)
        landmarks = landmarks[rows]
    state = start.state(landmarks, observations.rows()[0])
    noise = StaticNoise(config.reprojection_sigma_px, config.depth_sigma, config.depth_correlation)
    solves: list[SolveSummary] = []
    merged: MergedTracks | None = None
    covariances, stretched = unknown_covariances(len(start.world_T_cam)), 0.0
    rounds = 2 if energy.is_likelihood and config.measure_noise else 1
    motion = starting_prior(config.acceleration, timestamps, start.world_T_cam, landmarks)

    def declare(
        state: State, observations: Observations, noise: StaticNoise, settings: BundleAdjustmentConfig
    ) -> Problem:
        return bundle_adjustment_problem(
            state, observations, noise, settings, prior_intrinsics[None], freedom, energy, acceleration=motion
        )

    def declare_last(state: State, observations: Observations) -> tuple[Stage, State]:
        """Declare the last solve of some of the landmarks, added factors included."""
        problem = declare(state, observations, noise, config)
        joined = joined_by(run, Stage("bundle_adjustment", problem, near_the_minimum(config.solver)), state)
        return joined.stage, joined.state

    for index in range(rounds):
        settings = held_to_the_cue(noise, config) if index < rounds - 1 else (noise, config)
        problem = declare(state, observations, *settings)
        return_free_memory(LARGE)
        if index == 1 and freedom.poses and motion.is_weak:
            motion = estimate_prior(motion, problem, state, config.solver, noise.overstated)
            problem = declare(state, observations, noise, config)
        stage = Stage("bundle_adjustment", problem, config.solver if index == 0 else near_the_minimum(config.solver))
        state, summary = run(stage, state, hooks)
        solves.append(summary)
        if summary.termination is Termination.CANCELLED:
            break
        cue_holds_scale = config.depth_prior and freedom.poses and HOLDS_SCALE not in summary.notes
        if cue_holds_scale:
            state = hold_metric_scale(state)
        if index == rounds - 1 and energy.is_likelihood:
            known_to = None if freedom.intrinsics else focal_sigma
            covariances = _covariances(stage, state, observations, config, run, known_to)
            if known_to:
                stretched = focal_depth_error(declare_last, state, observations, known_to, hooks)
        del problem, stage  # as large as the observations, of which the next solve has others
        state, observations = drop_outliers(state, observations, config, dropped)
        if len(observations) == 0:
            counts = ", ".join(f"{count} x {reason}" for reason, count in dropped.items() if count)
            raise DegenerateProblemError(
                f"bundle adjustment: every observation was dropped in round {index + 1} ({counts}); "
                "check intrinsics and masks, or raise max_reprojection_px and max_depth_ratio"
            )
        noise = measure_noise(state, observations, noise, config)
        if index < rounds - 1:
            observations = weigh_by_residuals(state, observations, config)
        if find_fragments is not None and index < rounds - 1:
            state, observations, merged = merge_tracks(state, observations, find_fragments(state, observations, noise))
    if config.structure == "refine" and energy.is_likelihood and solves[-1].termination is not Termination.CANCELLED:
        state, noise, refined = refine_structure(state, observations, noise, config, hooks, run)
        solves += refined
        if cue_holds_scale:
            state = hold_metric_scale(state)
    if others is not None and solves[-1].termination is not Termination.CANCELLED:
        held, others, refined = further_landmarks(state, others, noise, config, dropped, hooks, run)
        solves += refined
        state, observations = joined_landmarks([state, held]), Observations.joined([observations, others])
    if config.structure == "relift":
        state = relift_structure(state, observations)
    keep = spatial_inliers(state[LANDMARK], config)
    dropped["landmark far from its neighbors"] = int((~keep).sum())
    if not keep.any():
        raise DegenerateProblemError(
            f"bundle adjustment: all {len(keep)} landmarks are dropped as far from their neighbors; "
            "raise outlier_factor or outlier_quantile"
        )
    track = state.numbers(LANDMARK)[:, 0]
    error = landmark_errors(state, observations)[keep]
    observations = observations.select(np.isin(observations.track, track[keep]))
    scene = StaticScene(
        Cameras.of(state), state[LANDMARK][keep], track[keep], observations, noise, error,
        *covariances, solves, dropped, acceleration=motion if energy.is_likelihood else None,
        focal_depth_error=stretched,
    )  # fmt: skip
    return scene if merged is None else merged.split(scene)


def near_the_minimum(solver: SolverConfig) -> SolverConfig:
    """Return the options of a solve that starts near its minimum."""
    return solver.model_copy(update={"initial_damping": min(solver.initial_damping, NEAR_DAMPING)})


def held_to_the_cue(noise: StaticNoise, config: BundleAdjustmentConfig) -> tuple[StaticNoise, BundleAdjustmentConfig]:
    """Return the noise and the settings of solves that the noise of the cue is measured after."""
    if config.first_depth_sigma is None:
        return noise, config
    closely = replace(noise, depth_sigma=config.first_depth_sigma, depth_correlation=0.0)
    return closely, config.model_copy(update={"depth_sigma_factor": 1.0, "depth_kernel": _FIRST_DEPTH_KERNEL})


def hold_metric_scale(state: State) -> State:
    """Scale the world about frame 0's center so that the frames' log-scales have zero mean.

    Reprojection does not see the scale of the world, and the widened depth prior holds it weakly: the cue's
    mean over all frames is the best metric scale there is. After the structure was refined, it is the mean of scales
    that were solved with the cue's own noise, so that its kernel leaves out the points whose depth is wrong for their
    parallax (behind the edge of a surface in front); the widened prior counts them in full, and the path is 1 % long.
    """
    log_scale = state[LOG_SCALE]
    shift = float(np.mean(log_scale[:, 0]))
    factor = np.exp(-shift)
    poses = state[POSE].copy()
    center = poses[0, :3, 3].copy()
    poses[:, :3, 3] = center + factor * (poses[:, :3, 3] - center)
    landmarks = center + factor * (state[LANDMARK] - center)
    return state.replace({POSE: poses, LOG_SCALE: log_scale - shift, LANDMARK: landmarks})


def _covariances(
    stage: Stage,
    state: State,
    observations: Observations,
    config: BundleAdjustmentConfig,
    run: StageRunner,
    focal_sigma: float | None,
) -> tuple[FloatArray, FloatArray]:
    """Return the marginal covariances of poses and intrinsics at the end of a MAP solve, added factors included.

    With ``focal_sigma`` the focal lengths were held, and their logarithms have that standard deviation; they count as
    exact without.
    """
    considered = None
    if focal_sigma:
        considered = considered_focal_lengths(state[INTRINSICS][0], focal_sigma, config.aspect_prior_sigma)
        free = {**stage.problem.free, **all_free(state, INTRINSICS)}
        stage = replace(stage, problem=replace(stage.problem, free=free))
    joined, clusters = joined_by(run, stage, state), track_cells(observations, state[INTRINSICS][0], config)
    marginals = static_marginals(joined.stage, joined.state, clusters, considered=considered)
    if marginals is None and joined.added:  # added variables that nothing determines say nothing of the cameras
        marginals = static_marginals(stage, state, clusters, considered=considered)
    if marginals is None:
        return unknown_covariances(len(state[POSE]))
    return marginals.blocks(POSE, len(state[POSE])), marginals.blocks(INTRINSICS, 1)[0]
