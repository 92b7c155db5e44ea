"""Stage 3: one world point per dynamic track and frame, cameras frozen.

Points start at the lift of the depth cue corrected by its frame's scale; frames in which a track is hidden
between two observations are bridged linearly. As-rigid-as-possible links each track to its nearest
neighbors of the same instance; temporal smoothness links a track to itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.stages import NonRigidConfig
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import dynamic_depth_prior
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection
from uni4d_fg.factors.state import State
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness, velocity_smoothness
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Round, Stage, StageRunner, run_stage
from uni4d_fg.slam.stages.energy import MAP, Energy, kernel_of
from uni4d_fg.slam.stages.lifting import lift
from uni4d_fg.slam.stages.neighbors import nearest_neighbors
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.proximal import LiftNoise, proximal_term
from uni4d_fg.slam.stages.scene import Cameras, DynamicScene, StaticNoise


@dataclass(frozen=True)
class PointMesh:
    """Dynamic points as rows ordered by track and frame, and how they are linked."""

    track: IntArray
    """(M,) labelled track of each trajectory."""
    instance: IntArray
    """(M,) mask id of each trajectory."""
    row: IntArray
    """(M, T) row of point (trajectory, frame); -1 where there is none."""
    observed: BoolArray
    """(M, T)."""
    pairs: IntArray
    """(L, 2) neighboring trajectories, each pair once."""
    times: IntArray
    """(L,) 2 where each of a pair is a neighbor of the other, else 1."""

    @property
    def num_points(self) -> int:
        """Number of rows P."""
        return int((self.row >= 0).sum())

    def consecutive(self, steps: int, observed_only: bool) -> list[IntArray]:
        """Return the rows of every run of ``steps`` consecutive frames of a trajectory, one array per step."""
        exists = self.row >= 0
        if observed_only:
            exists = exists & self.observed
        count = exists.shape[1] - steps + 1
        if count <= 0:
            return [np.zeros(0, dtype=np.int64)] * steps
        complete = np.logical_and.reduce([exists[:, i : i + count] for i in range(steps)])
        trajectory, frame = np.nonzero(complete)
        return [self.row[trajectory, frame + i] for i in range(steps)]

    def linked(self, observed_only: bool) -> tuple[list[IntArray], IntArray]:
        """Return the rows (k, t), (m, t), (k, t+1), (m, t+1) of every link that exists in both frames, and its pair."""
        exists = self.row >= 0
        if observed_only:
            exists = exists & self.observed
        both = exists[self.pairs[:, 0]] & exists[self.pairs[:, 1]]
        link, frame = np.nonzero(both[:, :-1] & both[:, 1:])
        k, m = self.pairs[link, 0], self.pairs[link, 1]
        return [self.row[k, frame], self.row[m, frame], self.row[k, frame + 1], self.row[m, frame + 1]], link


def nonrigid_problem(
    state: State,
    mesh: PointMesh,
    observations: Observations,
    rows: IntArray,
    cameras: Cameras,
    noise: StaticNoise,
    config: NonRigidConfig,
    energy: Energy = MAP,
) -> Problem:
    """Put non-rigid bundle adjustment together.

    Args:
        state: Dynamic points (P), ordered by track and frame.
        mesh: Rows and links.
        observations: Observations of the mesh's tracks.
        rows: (N,) row of each observation.
        cameras: Frozen poses, intrinsics and depth scales.
        noise: Sigmas measured on the static scene.
        config: Stage 3.
        energy: Weighs the terms.
    """
    problem = Problem.over(state)
    problem.add(_data_terms(observations, rows, cameras, noise, config, energy))
    return problem.add(motion_terms(mesh, config, energy))


def motion_terms(mesh: PointMesh, config: NonRigidConfig, energy: Energy = MAP) -> list[FactorBatch]:
    """Return E_motion: temporal smoothness and ARAP, where they are switched on."""
    terms = []
    steps = mesh.consecutive(config.smoothness_order + 1, observed_only=not config.bridge_gaps)
    count = len(steps[0])
    if config.smoothness_weight > 0 and count:
        smoothness = velocity_smoothness if config.smoothness_order == 1 else acceleration_smoothness
        sigma, weight, kernel = config.smoothness_sigma_m, config.smoothness_weight, config.smoothness_kernel
        terms.append(smoothness(*steps, **energy.linked(sigma, weight, kernel, count)))
    links, pair = mesh.linked(observed_only=not config.bridge_gaps)
    twice = config.arap_mutual_pairs == "twice"
    count = int(mesh.times[pair].sum()) if twice else len(pair)
    if config.arap_weight > 0 and count:
        weighed = energy.linked(config.arap_sigma_m, config.arap_weight, config.arap_kernel, count)
        if twice:
            weighed["weight"] = weighed["weight"] * mesh.times[pair]
        terms.append(arap(*links, **weighed))
    return terms


def _schedules(config: NonRigidConfig) -> tuple[tuple[Round, ...], ...]:
    """Return the annealing after the warm-up, if any, and without it if both are asked for."""
    annealed = tuple(Round(smoothing=factor) for factor in config.annealing)
    factor = config.warm_up_reprojection_weight
    if factor == 1.0 or not config.depth_prior:  # without a depth prior nothing else holds the points
        return (annealed,)
    warmed = (Round(config.annealing[0], {dynamic_reprojection.name: factor}), *annealed)
    return (warmed, annealed) if config.also_without_warm_up else (warmed,)


def _data_terms(
    observations: Observations,
    rows: IntArray,
    cameras: Cameras,
    noise: StaticNoise,
    config: NonRigidConfig,
    energy: Energy,
) -> list[FactorBatch]:
    """Return E_NR and the depth prior."""
    out = []
    pose = cameras.world_T_cam[observations.frame]
    if config.reprojection:
        sigma = config.reprojection_sigma_px or noise.reprojection_sigma_px
        weighed = energy.observed(
            sigma, observations.weight, config.reprojection_kernel, observations.frame, len(cameras.world_T_cam)
        )
        intrinsics = np.broadcast_to(cameras.intrinsics, (len(rows), 4))
        out.append(dynamic_reprojection(rows, uv=observations.uv, world_T_cam=pose, intrinsics=intrinsics, **weighed))
    known = np.isfinite(observations.depth)
    if config.depth_prior and known.any():
        seen = observations.select(known)
        out.append(
            dynamic_depth_prior(
                rows[known],
                depth=seen.depth,
                world_T_cam=pose[known],
                log_scale=cameras.log_scale[seen.frame],
                sigma=config.depth_sigma or noise.depth_sigma,
                weight=seen.weight,
                kernel=kernel_of(config.depth_kernel),
            )
        )
    return out


def build_mesh(
    observations: Observations,
    instance_of_track: IntArray,
    num_frames: int,
    cameras: Cameras,
    config: NonRigidConfig,
    dropped: dict[str, int],
) -> tuple[PointMesh, Observations, IntArray, State]:
    """Choose trajectories, lift their points and link neighbors.

    Returns:
        The mesh, the observations of its tracks, the row of each observation, and the starting state.
    """
    before = len(np.unique(observations.track))
    observations = observations.with_min_observations(min(config.min_observations, num_frames))
    lifted = lift(observations, cameras)
    usable = np.isfinite(lifted).all(axis=1)
    num_lifted = np.bincount(observations.track, usable, minlength=1)[observations.track]
    with_depth = num_lifted >= min(config.min_depth_observations, num_frames)
    dropped["dynamic track with too few observations"] = before - len(np.unique(observations.track))
    dropped["dynamic track with too little depth"] = len(np.unique(observations.track[~with_depth]))
    observations, lifted = observations.select(with_depth), lifted[with_depth]
    tracks, trajectory = observations.rows()
    observed = np.zeros((len(tracks), num_frames), dtype=bool)
    observed[trajectory, observations.frame] = True
    exists = observed.copy()
    if config.bridge_gaps:
        exists = (
            np.logical_or.accumulate(observed, axis=1) & np.logical_or.accumulate(observed[:, ::-1], axis=1)[:, ::-1]
        )
    row = np.full((len(tracks), num_frames), -1)
    row[exists] = np.arange(int(exists.sum()))
    points = np.full((len(tracks), num_frames, 3), np.nan)
    points[trajectory, observations.frame] = lifted
    _interpolate(points, exists)
    instance = instance_of_track[tracks]
    pairs, times = nearest_neighbors(points, observed, instance, config.neighbors, config.max_neighbor_ratio)
    trajectory_of, frame_of = np.nonzero(exists)
    track_frame = np.stack([tracks[trajectory_of], frame_of], axis=1)
    state = State({DYNAMIC_POINT: points[exists]}, {DYNAMIC_POINT: track_frame})
    mesh = PointMesh(tracks, instance, row, observed, pairs, times)
    return mesh, observations, row[trajectory, observations.frame], state


def _interpolate(points: FloatArray, exists: BoolArray) -> None:
    """Fill points (M, T, 3) that exist but were not lifted, linearly in time; ends are held."""
    missing = exists & ~np.isfinite(points).all(axis=2)
    for k in np.flatnonzero(missing.any(axis=1)).tolist():
        known = np.flatnonzero(np.isfinite(points[k]).all(axis=1))
        gaps = np.flatnonzero(missing[k])
        for a in range(3):
            points[k, gaps, a] = np.interp(gaps, known, points[k, known, a])


def solve_nonrigid(
    observations: Observations,
    instance_of_track: IntArray,
    cameras: Cameras,
    noise: StaticNoise,
    config: NonRigidConfig,
    energy: Energy = MAP,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
    lift_noise: LiftNoise | None = None,
) -> DynamicScene:
    """Run stage 3; without dynamic tracks the result is empty.

    Args:
        observations: Trusted observations of dynamic tracks.
        instance_of_track: (K,) mask id per labelled track.
        cameras: Frozen poses, intrinsics and depth scales.
        noise: Sigmas measured on the static scene.
        config: Stage 3.
        energy: Weighs the terms.
        hooks: Progress and cancellation.
        run: What solves the declared stage.
        lift_noise: Of the proximal term; None takes the depth noise of ``noise`` and the cameras' scales.

    Raises:
        SolverError: If the system is singular or a cue is not finite.
    """
    num_frames = len(cameras.world_T_cam)
    dropped: dict[str, int] = {}
    mesh, observations, rows, state = build_mesh(observations, instance_of_track, num_frames, cameras, config, dropped)
    if mesh.num_points == 0:
        empty = np.zeros((0, num_frames))
        return DynamicScene(empty[..., None] + np.zeros(3), empty > 0, mesh.track, mesh.instance, None, dropped)
    problem = nonrigid_problem(state, mesh, observations, rows, cameras, noise, config, energy)
    bounds: frozenset[str] = frozenset()
    solver = config.solver
    if config.proximal_weight > 0:
        lift_noise = lift_noise or LiftNoise(cameras.log_scale, noise.depth_sigma)
        bound = proximal_term(observations, rows, cameras, lift_noise, config, energy)
        problem, bounds = problem.add(bound), frozenset({bound.name})
        solver = solver.model_copy(update={"cg_tolerance": config.proximal_cg_tolerance})
    stage = Stage(
        "nonrigid", problem, solver, schedules=_schedules(config), bounds=bounds, unbounded_solver=config.solver
    )
    state, summary = run(stage, state, hooks)
    points = np.full((*mesh.row.shape, 3), np.nan)
    points[mesh.row >= 0] = state[DYNAMIC_POINT]
    near, calm = spatial_inliers(points, mesh, config), energy_inliers(points, mesh, config)
    keep = near & calm
    dropped["dynamic track far from its instance"] = int((~near).sum())
    dropped["dynamic track with a large motion energy"] = int((near & ~calm).sum())
    return DynamicScene(points[keep], mesh.observed[keep], mesh.track[keep], mesh.instance[keep], summary, dropped)


def energy_inliers(points: FloatArray, mesh: PointMesh, config: NonRigidConfig) -> BoolArray:
    """Return which trajectories move plausibly.

    A trajectory's score is the largest over its frames of its own smoothness residual plus the mean change
    of the distances to its neighbors, both in sigmas; scores above the quantile plus margin are dropped.
    """
    step = np.linalg.norm(np.diff(points, n=config.smoothness_order, axis=1), axis=2)
    if step.shape[1] == 0:
        return np.ones(len(points), dtype=bool)
    score = np.nan_to_num(step) / config.smoothness_sigma_m
    first, second = mesh.pairs[:, 0], mesh.pairs[:, 1]
    change = np.abs(np.diff(np.linalg.norm(points[first] - points[second], axis=2), axis=1)) / config.arap_sigma_m
    known = np.isfinite(change)
    total, count = np.zeros((2, len(points), change.shape[1]))
    for end in (first, second):
        np.add.at(total, end, np.where(known, change, 0.0))
        np.add.at(count, end, known)
    score = score + (total / np.maximum(count, 1.0))[:, : score.shape[1]]
    worst = score.max(axis=1)
    result: BoolArray = worst <= np.quantile(worst, config.outlier_quantile) + config.outlier_margin
    return result


def spatial_inliers(points: FloatArray, mesh: PointMesh, config: NonRigidConfig) -> BoolArray:
    """Return which trajectories are near others of their instance.

    A trajectory's score is the median over its observed frames of the distance to its nearest neighbor; one
    above ``max_neighbor_ratio`` times the instance's median score floats in space (a wrong depth, mostly).
    """
    seen = mesh.observed & np.isfinite(points).all(axis=2)
    nearest = np.full(seen.shape, np.nan)
    for label in np.unique(mesh.instance).tolist():
        members = mesh.instance == label
        for frame in np.flatnonzero((seen & members[:, None]).sum(axis=0) > 1).tolist():
            present = np.flatnonzero(members & seen[:, frame])
            distance, _ = cKDTree(points[present, frame]).query(points[present, frame], k=2)
            nearest[present, frame] = distance[:, 1]
    keep = np.ones(len(points), dtype=bool)
    rated = np.flatnonzero(np.isfinite(nearest).any(axis=1))
    score = np.nanmedian(nearest[rated], axis=1)
    for label in np.unique(mesh.instance[rated]).tolist():
        mine = mesh.instance[rated] == label
        typical = max(float(np.median(score[mine])), config.arap_sigma_m)  # coinciding tracks have none
        keep[rated[mine]] = score[mine] <= config.max_neighbor_ratio * typical
    return keep
