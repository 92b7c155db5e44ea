"""The static points of given cameras: their terms, where they start, and their refinement.

Bundle adjustment solves them together with the cameras; here the cameras are held, and nothing couples the points but
the frames' depth scales.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.allocation import LARGE, return_free_memory
from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import static_depth_prior
from uni4d_fg.factors.priors import log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner, early, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.stages.energy import MAP, Energy, kernel_of
from uni4d_fg.slam.stages.frame_noise import weigh_by_frame
from uni4d_fg.slam.stages.lifting import lift, mean_per_row
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise
from uni4d_fg.slam.stages.static_outliers import drop_outliers, measure_noise, reprojection_residual


def reprojection_term(
    observations: Observations,
    row: IntArray,
    sigma: float,
    num_frames: int,
    config: BundleAdjustmentConfig,
    energy: Energy,
) -> FactorBatch:
    """Return E_BA; ``row`` (N,) is the landmark row of each observation."""
    noise = energy.observed(sigma, observations.weight, config.reprojection_kernel, observations.frame, num_frames)
    return static_reprojection(observations.frame, row, 0, uv=observations.uv, **noise)


def depth_prior_terms(
    observations: Observations,
    row: IntArray,
    sigma: float,
    num_frames: int,
    config: BundleAdjustmentConfig,
    log_scale: float = 0.0,
) -> list[FactorBatch]:
    """Return the depth prior of every observation with a cue, and the prior on the frames' log-scales about one."""
    known = np.isfinite(observations.depth)
    frame = observations.frame[known]
    return [
        static_depth_prior(
            frame, row[known], frame, depth=observations.depth[known], sigma=sigma, weight=observations.weight[known],
            kernel=kernel_of(config.depth_kernel),
        ),
        log_scale_prior(
            np.arange(num_frames), measured=np.full((num_frames, 1), log_scale), sigma=config.depth_scale_prior_sigma
        ),
    ]  # fmt: skip


def structure_problem(
    state: State, observations: Observations, noise: StaticNoise, config: BundleAdjustmentConfig
) -> Problem:
    """Put the refinement of landmarks and frame scales with frozen cameras together.

    Bundle adjustment widens the depth prior (``depth_sigma_factor``) because the errors of a depth cue are
    correlated and would bias the cameras. With the cameras known, the structure is best where triangulation
    and all depth cues of a track agree, each at its own noise.
    """
    num_frames = len(state[POSE])
    _, row = observations.rows()
    problem = Problem.over(state).eliminate(LANDMARK).fix(POSE).fix(INTRINSICS)
    problem.add(reprojection_term(observations, row, noise.reprojection_sigma_px, num_frames, config, MAP))
    sigma = min(noise.depth_sigma, config.depth_sigma)
    return problem.add(depth_prior_terms(observations, row, sigma, num_frames, config))


def refine_structure(
    state: State,
    observations: Observations,
    noise: StaticNoise,
    config: BundleAdjustmentConfig,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
    kind: str = "structure",
) -> tuple[State, StaticNoise, list[SolveSummary]]:
    """Solve landmarks and frame scales under frozen cameras; return the state, the noise and the solves.

    Twice: the second solve uses the depth noise that the first one reveals, and starts where that ended.
    """
    solves = []
    for solver in (early(config.structure_solver), config.structure_solver):
        problem = structure_problem(state, observations, noise, config)
        return_free_memory(LARGE)
        state, summary = run(Stage(kind, problem, solver), state, hooks)
        del problem
        solves.append(summary)
        noise = measure_noise(state, observations, noise, config)
    return state, noise, solves


def relift_structure(state: State, observations: Observations) -> State:
    """Put every landmark at the mean lift of its depth cues, where it has any."""
    landmarks = state[LANDMARK]
    lifted = mean_lift(observations, Cameras.of(state))
    return state.replace({LANDMARK: np.where(np.isfinite(lifted), lifted, landmarks)})


def mean_lift(observations: Observations, cameras: Cameras) -> FloatArray:
    """Return where the depth cues of every track lift it to, (M, 3), as a mean by weight; NaN without any."""
    tracks, row = observations.rows()
    return mean_per_row(lift(observations, cameras), observations.weight, row, len(tracks))


def liftable(
    observations: Observations, cameras: Cameras, config: BundleAdjustmentConfig, dropped: dict[str, int]
) -> tuple[Observations, FloatArray]:
    """Keep tracks that are long enough and have depth; return them with their starting landmarks."""
    before = len(np.unique(observations.track))
    observations = observations.with_min_observations(min(config.min_observations, len(cameras.world_T_cam)))
    tracks, row = observations.rows()
    dropped["track with too few observations"] = before - len(tracks)
    landmarks = mean_lift(observations, cameras)
    known = np.asarray(np.isfinite(landmarks).all(axis=1))
    dropped["track without depth"] = int((~known).sum())
    return observations.select(known[row]), landmarks[known]


def further_landmarks(
    state: State,
    observations: Observations,
    noise: StaticNoise,
    config: BundleAdjustmentConfig,
    dropped: dict[str, int],
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> tuple[State, Observations, list[SolveSummary]]:
    """Refine the landmarks of tracks that had no part in finding the cameras.

    Cameras and scales are held, so that the parts of ``max_camera_observations`` that are solved one after the other
    know nothing of each other. Each starts at the lift of its depth cues, and observations are dropped and weighed
    as those of the camera solves are, after a first solve.

    Args:
        state: Solved cameras and scales; the landmarks are not looked at.
        observations: Observations of tracks that start can be found for.
        noise: Sigmas, as measured on the landmarks of the camera solves.
        config: Stage 2.
        dropped: Counts of what is dropped, which are added to.
        hooks: Progress and cancellation.
        run: What solves each part.

    Returns:
        The state with these landmarks alone, their observations, and the solves.
    """
    _, row = observations.rows()
    parts = -(-len(observations) // config.max_camera_observations)
    points, kept, solves = [], [], []
    for part in range(parts):
        some = observations.select(row % parts == part)  # of every frame alike, for weights by frame
        landmarks = mean_lift(some, Cameras.of(state))
        own = State({**state.arrays, LANDMARK: landmarks}, {**state.index, LANDMARK: some.rows()[0]})
        for is_last in (False, True):
            solver = config.structure_solver if is_last else early(config.structure_solver)
            problem = structure_problem(own, some, noise, config).fix(LOG_SCALE)
            return_free_memory(LARGE)
            own, summary = run(Stage("further_landmarks", problem, solver, part=str(part)), own, hooks)
            del problem
            solves.append(summary)
            if summary.termination is Termination.CANCELLED:
                break
            own, some = drop_outliers(own, some, config, dropped)
            if not is_last:
                residual = reprojection_residual(own, some, some.rows()[1])
                some = weigh_by_frame(residual, some, len(own[POSE]), config)
            if len(some) == 0:
                break
        points.append(own)
        kept.append(some)
        if solves[-1].termination is Termination.CANCELLED:
            break
    return joined_landmarks(points), Observations.joined(kept), solves


def joined_landmarks(states: list[State]) -> State:
    """Return the first state with the landmarks of all, in ascending order of track."""
    track = np.concatenate([each.numbers(LANDMARK)[:, 0] for each in states])
    order = np.argsort(track)
    points = np.concatenate([each[LANDMARK] for each in states])[order]
    first = states[0]
    return State({**first.arrays, LANDMARK: points}, {**first.index, LANDMARK: track[order]})
