"""Stage 2: bundle adjustment of poses, intrinsics, depth scales and landmarks.

Landmarks start at the mean lift of their depth cues. With the MAP energy a first solve uses the configured
sigmas; observations that disagree are dropped, the noise of reprojection and of depth is measured on what
stays, and a second solve uses it. Frame 0's pose is the gauge; the depth prior (or, without it, the distance
of the two farthest cameras) holds the scale.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.config.stages import BundleAdjustmentConfig, CameraMotionConfig
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.depth_prior import STATIC_DEPTH_PRIOR
from uni4d_fg.factors.priors import LOG_SCALE_PRIOR, SCALE_ANCHOR
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.geometry.camera import NEAR_PLANE, world_to_camera
from uni4d_fg.graph.state import State, VariableNames
from uni4d_fg.solve.clustered import Clusters, Spread, clustered_marginals, image_cells
from uni4d_fg.solve.levenberg_marquardt import Hooks
from uni4d_fg.solve.marginals import CameraMarginals, camera_marginals
from uni4d_fg.solve.summary import SolveSummary, Termination
from uni4d_fg.stages.lifting import lift, mean_per_row
from uni4d_fg.stages.noise import intraclass_correlation, robust_sigma
from uni4d_fg.stages.observations import Normalization, Observations, reprojection_weights
from uni4d_fg.stages.stage import Stage, StageRunner, kernel_of, run_stage
from uni4d_fg.stages.terms import camera_motion_terms, intrinsics_priors


@dataclass(frozen=True)
class StaticNoise:
    """Noise of the static scene: what dynamic points are then judged by."""

    reprojection_sigma_px: float
    depth_sigma: float
    depth_correlation: float = 0.0
    """How alike the log-depth errors of one track are, in [0, 1]."""

    def effective_depth_sigma(self, observations_per_track: float) -> float:
        """Return the sigma at which n equally correlated depths of a track carry the information they have.

        n values with correlation c carry as much as ``n / (1 + (n - 1) c)`` independent ones.
        """
        return self.depth_sigma * float(np.sqrt(1.0 + max(observations_per_track - 1.0, 0.0) * self.depth_correlation))


@dataclass(frozen=True)
class BundleAdjustmentResult:
    """The static scene at the end of stage 2."""

    world_T_cam: FloatArray
    """(T, 4, 4)."""
    intrinsics: FloatArray
    """(4,)."""
    log_scale: FloatArray
    """(T,)."""
    landmarks: FloatArray
    """(N, 3)."""
    landmark_track: IntArray
    """(N,)."""
    observations: Observations
    """Observations of the kept landmarks."""
    noise: StaticNoise
    landmark_error: Float32Array
    """(N,) median reprojection error, px."""
    pose_covariance: FloatArray
    """(T, 6, 6) marginal covariance of each pose's body-frame twist (rad, m), relative to frame 0; NaN if unknown."""
    intrinsics_covariance: FloatArray
    """(4, 4) px^2; zero for entries that are held, NaN if unknown."""
    solves: list[SolveSummary] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    """Number of observations or landmarks dropped, per reason."""


@dataclass(frozen=True)
class Freedom:
    """What stage 2 may move besides landmarks."""

    poses: bool
    intrinsics: bool


def without_camera_motion(config: BundleAdjustmentConfig) -> BundleAdjustmentConfig:
    """Return stage 2 without E_cam, which is made for consecutive frames."""
    still = CameraMotionConfig(rotation_weight=0.0, translation_weight=0.0)
    return config.model_copy(update={"camera_motion": still})


def bundle_adjustment_stage(
    state: State,
    observations: Observations,
    noise: StaticNoise,
    config: BundleAdjustmentConfig,
    prior_intrinsics: FloatArray,
    freedom: Freedom,
    *,
    unsquared: bool,
    normalization: Normalization,
) -> Stage:
    """Declare one solve.

    Args:
        state: Poses (T), intrinsics, log-scales and landmarks (rows named by track).
        observations: Observations of exactly those landmarks.
        noise: Sigmas of the MAP energy.
        config: Stage 2.
        prior_intrinsics: (1, 4) centre of the intrinsics' prior.
        freedom: What is free besides landmarks and log-scales.
        unsquared: The paper's energy (mean or summed norms) instead of the MAP estimate.
        normalization: Weights of the paper's energy.
    """
    num_frames = len(state["pose"])
    _, row = observations.rows()
    weight = observations.weight
    if unsquared:
        weight = reprojection_weights(observations.frame, weight, num_frames, normalization)
    batches = [reprojection_term(observations, row, 1.0 if unsquared else noise.reprojection_sigma_px, weight, config)]
    batches += camera_motion_terms(np.arange(num_frames), config.camera_motion, unsquared)
    free: dict[str, BoolArray] = {"landmark": np.ones((len(state["landmark"]), 3), dtype=bool)}
    if freedom.poses:
        free["pose"] = np.ones((num_frames, 6), dtype=bool)
        free["pose"][0] = False
    if freedom.intrinsics:
        centre = config.free_principal_point
        free["intrinsics"] = np.array([[True, True, centre, centre]])
        if not unsquared:
            batches += intrinsics_priors(prior_intrinsics, config.focal_prior_fraction, config.aspect_prior_sigma)
    if config.depth_prior:
        free["log_scale"] = np.ones((num_frames, 1), dtype=bool)
        per_track = len(observations) / max(len(state["landmark"]), 1)
        sigma = noise.effective_depth_sigma(per_track) * config.depth_sigma_factor
        batches += depth_prior_terms(observations, row, sigma, num_frames, config)
    elif freedom.poses:
        batches += scale_anchor(state["pose"])
    return Stage("bundle_adjustment", tuple(batches), free, config.solver, "schur", eliminate="landmark")


def structure_stage(
    state: State, observations: Observations, noise: StaticNoise, config: BundleAdjustmentConfig
) -> Stage:
    """Declare the refinement of landmarks and frame scales with frozen cameras.

    Bundle adjustment widens the depth prior (``depth_sigma_factor``) because the errors of a depth cue are
    correlated and would bias the cameras. With the cameras known, the structure is best where triangulation
    and all depth cues of a track agree, each at its own noise.
    """
    num_frames = len(state["pose"])
    _, row = observations.rows()
    reprojection = reprojection_term(observations, row, noise.reprojection_sigma_px, observations.weight, config)
    depth = depth_prior_terms(observations, row, min(noise.depth_sigma, config.depth_sigma), num_frames, config)
    free = {
        "landmark": np.ones((len(state["landmark"]), 3), dtype=bool),
        "log_scale": np.ones((num_frames, 1), dtype=bool),
    }
    return Stage("structure", (reprojection, *depth), free, config.structure_solver, "schur", eliminate="landmark")


def reprojection_term(
    observations: Observations, row: IntArray, sigma: float, weight: FloatArray, config: BundleAdjustmentConfig
) -> FactorBatch:
    """Return E_BA; ``row`` (N,) is the landmark row of each observation."""
    return FactorBatch.create(
        STATIC_REPROJECTION,
        (Slot("pose", observations.frame), Slot("landmark", row), Slot("intrinsics", np.zeros_like(row))),
        {"uv": observations.uv},
        sigma=sigma,
        weight=weight,
        kernel=kernel_of(config.reprojection_kernel),
    )


def depth_prior_terms(
    observations: Observations, row: IntArray, sigma: float, num_frames: int, config: BundleAdjustmentConfig
) -> list[FactorBatch]:
    """Return the depth prior of every observation with a cue, and the prior on the frames' log-scales."""
    known = np.isfinite(observations.depth)
    with_depth = observations.select(known)
    slots = (Slot("pose", with_depth.frame), Slot("landmark", row[known]), Slot("log_scale", with_depth.frame))
    return [
        FactorBatch.create(
            STATIC_DEPTH_PRIOR,
            slots,
            {"depth": with_depth.depth},
            sigma=sigma,
            weight=with_depth.weight,
            kernel=kernel_of(config.depth_kernel),
        ),
        FactorBatch.create(
            LOG_SCALE_PRIOR,
            (Slot("log_scale", np.arange(num_frames)),),
            {"measured": np.zeros((num_frames, 1))},
            sigma=config.depth_scale_prior_sigma,
        ),
    ]


def scale_anchor(world_T_cam: FloatArray) -> list[FactorBatch]:
    """Hold the distance between frame 0 and the camera farthest from it; empty for a camera at rest."""
    distance = np.linalg.norm(world_T_cam[:, :3, 3] - world_T_cam[0, :3, 3], axis=1)
    farthest = int(np.argmax(distance))
    if distance[farthest] < 1e-6:
        return []
    slots = (Slot("pose", np.zeros(1, dtype=np.int64)), Slot("pose", np.array([farthest])))
    return [FactorBatch.create(SCALE_ANCHOR, slots, {"distance": distance[[farthest]]}, sigma=1e-3)]


def adjust_bundle(
    observations: Observations,
    world_T_cam: FloatArray,
    intrinsics: FloatArray,
    prior_intrinsics: FloatArray,
    config: BundleAdjustmentConfig,
    freedom: Freedom,
    *,
    unsquared: bool,
    normalization: Normalization,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> BundleAdjustmentResult:
    """Run stage 2 from the poses and intrinsics of stage 1.

    Args:
        observations: Trusted observations of static tracks.
        world_T_cam: (T, 4, 4) starting poses.
        intrinsics: (4,) starting intrinsics.
        prior_intrinsics: (4,) the sequence's own intrinsics.
        config: Stage 2.
        freedom: Whether poses and intrinsics move.
        unsquared: The paper's energy instead of the MAP estimate.
        normalization: Weights of the paper's energy.
        hooks: Progress and cancellation.
        run: What solves each declared stage.

    Raises:
        DegenerateProblemError: If no static track can be lifted, or none survives the outlier rules.
        SolverError: If the system is singular or a cue is not finite.
    """
    num_frames = len(world_T_cam)
    dropped: dict[str, int] = {}
    zero_scale = np.zeros(num_frames)
    observations, landmarks = _liftable(observations, world_T_cam, intrinsics, config, dropped)
    if len(observations) == 0:
        raise DegenerateProblemError(
            "bundle adjustment: no static track has depth in any frame and is seen in "
            f"{config.min_observations} frames. Check masks and depth with 'uni4d-fg validate'."
        )
    state = _make_state(world_T_cam, intrinsics, zero_scale, landmarks, observations)
    noise = StaticNoise(config.reprojection_sigma_px, config.depth_sigma, config.depth_correlation)
    solves: list[SolveSummary] = []
    pose_covariance, intrinsics_covariance = unknown_covariances(num_frames)
    rounds = 1 if unsquared or not config.measure_noise else 2
    for index in range(rounds):
        stage = bundle_adjustment_stage(
            state, observations, noise, config, prior_intrinsics[None], freedom,
            unsquared=unsquared, normalization=normalization,
        )  # fmt: skip
        state, summary = run(stage, state, hooks)
        solves.append(summary)
        if summary.termination is Termination.CANCELLED:
            break
        if config.depth_prior and freedom.poses:
            scaled = hold_metric_scale(state["pose"], state["log_scale"][:, 0], state["landmark"])
            state = state.replace(pose=scaled[0], log_scale=scaled[1][:, None], landmark=scaled[2])
        if index == rounds - 1 and not unsquared:
            pose_covariance, intrinsics_covariance = _covariances(stage, state, observations, config)
        state, observations = drop_outliers(state, observations, config, dropped)
        if len(observations) == 0:
            counts = ", ".join(f"{count} x {reason}" for reason, count in dropped.items() if count)
            raise DegenerateProblemError(
                f"bundle adjustment: every observation was dropped in round {index + 1} ({counts}); "
                "check intrinsics and masks, or raise max_reprojection_px and max_depth_ratio"
            )
        noise = measure_noise(state, observations, noise, config)
    if config.structure == "refine" and not unsquared and solves[-1].termination is not Termination.CANCELLED:
        for _ in range(2):  # the second solve uses the depth noise that the first one reveals
            state, summary = run(structure_stage(state, observations, noise, config), state, hooks)
            solves.append(summary)
            noise = measure_noise(state, observations, noise, config)
    landmarks = state["landmark"]
    if config.structure == "relift":
        tracks, row = observations.rows()
        points = lift(observations, state["pose"], state["intrinsics"][0], state["log_scale"][:, 0])
        relifted = mean_per_row(points, observations.weight, row, len(tracks))
        landmarks = np.where(np.isfinite(relifted), relifted, landmarks)
    track = state.names.landmark_track
    assert track is not None
    keep = spatial_inliers(landmarks, config)
    dropped["landmark far from its neighbours"] = int((~keep).sum())
    if not keep.any():
        raise DegenerateProblemError(
            f"bundle adjustment: all {len(keep)} landmarks are dropped as far from their neighbours; "
            "raise outlier_factor or outlier_quantile"
        )
    error = landmark_errors(state.replace(landmark=landmarks), observations)[keep]
    observations = observations.select(np.isin(observations.track, track[keep]))
    return BundleAdjustmentResult(
        state["pose"], state["intrinsics"][0], state["log_scale"][:, 0], landmarks[keep], track[keep],
        observations, noise, error, pose_covariance, intrinsics_covariance, solves, dropped,
    )  # fmt: skip


def unknown_covariances(num_frames: int) -> tuple[FloatArray, FloatArray]:
    """Return pose (T, 6, 6) and intrinsics (4, 4) covariances that say nothing: NaN."""
    return np.full((num_frames, 6, 6), np.nan), np.full((4, 4), np.nan)


def _covariances(
    stage: Stage, state: State, observations: Observations, config: BundleAdjustmentConfig
) -> tuple[FloatArray, FloatArray]:
    """Return the marginal covariances at the end of a MAP solve; the paper's norms are no likelihood."""
    marginals = static_marginals(stage, state, track_cells(observations, state["intrinsics"][0], config))
    if marginals is None:
        return unknown_covariances(len(state["pose"]))
    return marginals.blocks("pose", len(state["pose"])), marginals.blocks("intrinsics", 1)[0]


def track_cells(observations: Observations, intrinsics: FloatArray, config: BundleAdjustmentConfig) -> Clusters | None:
    """Put tracks, in ascending order, into clusters by the image cell of their first observation; None if off."""
    if config.covariance_cells == 0:
        return None
    order = np.lexsort([observations.frame, observations.track])
    _, first = np.unique(observations.track[order], return_index=True)
    cells = image_cells(observations.uv[order[first]], intrinsics, config.covariance_cells)
    return Clusters(cells, config.covariance_cells**2)


def static_marginals(
    stage: Stage, state: State, clusters: Clusters | None, carried: Spread | None = None
) -> CameraMarginals | None:
    """Return the joint covariance of the cameras of a stage, with or without clusters of landmarks."""
    if clusters is None or stage.eliminate is None:
        return camera_marginals(stage.problem, state, stage.solver, stage.eliminate)
    return clustered_marginals(stage.problem, state, stage.solver, clusters, stage.eliminate, carried)


def hold_metric_scale(
    world_T_cam: FloatArray, log_scale: FloatArray, landmarks: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scale the world about frame 0's centre so that the frames' log-scales (T,) have zero mean.

    Reprojection does not see the scale of the world, and the widened depth prior holds it weakly: the cue's
    mean over all frames is the best metric scale there is.
    """
    shift = float(np.mean(log_scale))
    factor = np.exp(-shift)
    poses = world_T_cam.copy()
    centre = poses[0, :3, 3].copy()
    poses[:, :3, 3] = centre + factor * (poses[:, :3, 3] - centre)
    return poses, log_scale - shift, centre + factor * (landmarks - centre)


def reprojection_residual(state: State, observations: Observations, row: IntArray) -> FloatArray:
    """Return the raw reprojection residual of every observation, (N, 2) px; ``row`` is its landmark's row."""
    pose, landmark = state["pose"][observations.frame], state["landmark"][row]
    residual: FloatArray = STATIC_REPROJECTION.residual(pose, landmark, state["intrinsics"], uv=observations.uv)
    return residual


def landmark_errors(state: State, observations: Observations) -> Float32Array:
    """Return each landmark's median reprojection error, (N,) px."""
    tracks, row = observations.rows()
    residual = reprojection_residual(state, observations, row)
    norm = np.linalg.norm(residual, axis=1)
    order = np.lexsort([norm, row])
    start = np.searchsorted(row[order], np.arange(len(tracks) + 1))
    middle = (start[:-1] + start[1:] - 1) // 2
    return np.asarray(norm[order][middle], dtype=np.float32)


def _make_state(
    world_T_cam: FloatArray, intrinsics: FloatArray, log_scale: FloatArray, landmarks: FloatArray, obs: Observations
) -> State:
    tracks, _ = obs.rows()
    groups = {
        "pose": world_T_cam,
        "intrinsics": intrinsics.reshape(1, 4),
        "log_scale": log_scale.reshape(-1, 1),
        "landmark": landmarks,
    }
    return State(groups, VariableNames(landmark_track=tracks))


def _liftable(
    observations: Observations,
    world_T_cam: FloatArray,
    intrinsics: FloatArray,
    config: BundleAdjustmentConfig,
    dropped: dict[str, int],
) -> tuple[Observations, FloatArray]:
    """Keep tracks that are long enough and have depth; return them with their starting landmarks."""
    before = len(np.unique(observations.track))
    observations = observations.with_min_observations(min(config.min_observations, len(world_T_cam)))
    tracks, row = observations.rows()
    dropped["track with too few observations"] = before - len(tracks)
    points = lift(observations, world_T_cam, intrinsics, np.zeros(len(world_T_cam)))
    landmarks = mean_per_row(points, observations.weight, row, len(tracks))
    known = np.asarray(np.isfinite(landmarks).all(axis=1))
    dropped["track without depth"] = int((~known).sum())
    return observations.select(known[row]), landmarks[known]


def drop_outliers(
    state: State, observations: Observations, config: BundleAdjustmentConfig, dropped: dict[str, int]
) -> tuple[State, Observations]:
    """Drop observations behind the camera, too far off, or of landmarks whose depth contradicts the cue."""
    tracks, row = observations.rows()
    z = world_to_camera(state["pose"][observations.frame], state["landmark"][row])[:, 2]
    residual = reprojection_residual(state, observations, row)
    behind = z <= NEAR_PLANE
    far = ~behind & (np.linalg.norm(residual, axis=1) > config.max_reprojection_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.abs(
            np.log(np.maximum(z, NEAR_PLANE) / observations.depth) - state["log_scale"][observations.frame, 0]
        )
    known = np.isfinite(ratio)
    wrong = np.bincount(row[known], ratio[known] > np.log(config.max_depth_ratio), len(tracks))
    contradicted = (wrong > 0.5 * np.bincount(row[known], minlength=len(tracks))) & (wrong > 0)
    keep = ~(behind | far | contradicted[row])
    kept = observations.select(keep).with_min_observations(min(config.min_observations, len(state["pose"])))
    stays = np.isin(tracks, kept.track)
    for reason, count in (
        ("observation behind the camera", int(behind.sum())),
        ("observation with a large reprojection error", int(far.sum())),
        ("landmark whose depth contradicts the cue", int(contradicted.sum())),
        ("landmark left with too few observations", int((~stays & ~contradicted).sum())),
    ):
        dropped[reason] = dropped.get(reason, 0) + count
    names = VariableNames(landmark_track=tracks[stays])
    return State({**state.groups, "landmark": state["landmark"][stays]}, names), kept


def measure_noise(
    state: State, observations: Observations, noise: StaticNoise, config: BundleAdjustmentConfig
) -> StaticNoise:
    """Measure the noise of the static scene from what is left."""
    _, row = observations.rows()
    pose, landmark = state["pose"][observations.frame], state["landmark"][row]
    reprojection = reprojection_residual(state, observations, row)
    known = np.isfinite(observations.depth)
    depth = STATIC_DEPTH_PRIOR.residual(
        pose[known], landmark[known], state["log_scale"][observations.frame[known]], depth=observations.depth[known]
    )
    pixel, relative = robust_sigma(reprojection), robust_sigma(depth)
    return StaticNoise(
        max(pixel * config.reprojection_sigma_factor, config.min_reprojection_sigma_px),
        max(relative, config.min_depth_sigma) if np.isfinite(relative) else noise.depth_sigma,
        intraclass_correlation(depth[:, 0], row[known]) if np.isfinite(relative) else noise.depth_correlation,
    )


def spatial_inliers(landmarks: FloatArray, config: BundleAdjustmentConfig) -> BoolArray:
    """Return which landmarks are not isolated: mean squared distance to 5 neighbours below the quantile rule."""
    if len(landmarks) < 7:
        return np.ones(len(landmarks), dtype=bool)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(landmarks).query(landmarks, k=6)
    score = np.mean(distance[:, 1:] ** 2, axis=1)
    result: BoolArray = score <= config.outlier_factor * np.quantile(score, config.outlier_quantile)
    return result
