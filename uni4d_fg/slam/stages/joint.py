r"""The joint energy: cameras, static points and moving points free together.

    E = E_BA(C, P_static) + E_NR(P_dyn, C) + E_motion(P_dyn) + E_cam(C)

Uni4D states this energy (its first equation) and minimizes it in stages, with frozen cameras in the third. Here it is
one solve that starts where the stages ended. Its terms, sigmas and kernels are those of stages 2 and 3; the moving
points' reprojection and depth prior read the free cameras. Frame 0's pose is the gauge.

The frames' depth scales stay as stage 2 left them, because they hold the metric scale: reprojection does not see the
scale of the world, ARAP and smoothness get cheaper the smaller it is, and with free scales nothing else would object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import joint_dynamic_depth_prior
from uni4d_fg.factors.dynamic_reprojection import joint_dynamic_reprojection
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, bundle_adjustment_problem
from uni4d_fg.slam.stages.energy import Energy, energy_of, kernel_of
from uni4d_fg.slam.stages.neighbors import nearest_neighbors
from uni4d_fg.slam.stages.nonrigid import PointMesh, motion_terms
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, DynamicScene, StaticNoise, StaticScene
from uni4d_fg.slam.stages.static_outliers import drop_outliers, landmark_errors
from uni4d_fg.slam.stages.structure import refine_structure


@dataclass(frozen=True)
class MovingCues:
    """What is observed of moving points."""

    observations: Observations
    """Of dynamic tracks, with the depth cue in the scale of the frames: ``log_scale`` still to be added."""
    noise: StaticNoise
    """Sigmas of their reprojection and of their depth cue."""


def mesh_of(motion: DynamicScene, config: Config) -> PointMesh:
    """Return the trajectories of stage 3 as rows, linked to those that are nearest now."""
    exists = np.isfinite(motion.points).all(axis=2)
    row = np.full(exists.shape, -1)
    row[exists] = np.arange(int(exists.sum()))
    stage = config.nonrigid
    pairs, times = nearest_neighbors(
        motion.points, motion.observed, motion.instance, stage.neighbors, stage.max_neighbor_ratio
    )
    return PointMesh(motion.track, motion.instance, row, motion.observed, pairs, times)


def joint_state(scene: StaticScene, motion: DynamicScene, mesh: PointMesh) -> State:
    """Return every variable of the joint energy at the end of the stages."""
    static = scene.state()
    trajectory, frame = np.nonzero(mesh.row >= 0)
    index = {**static.index, DYNAMIC_POINT: np.stack([mesh.track[trajectory], frame], axis=1)}
    return State({**static.arrays, DYNAMIC_POINT: motion.points[trajectory, frame]}, index)


def joint_problem(
    state: State,
    scene: StaticScene,
    mesh: PointMesh,
    moving: MovingCues,
    config: Config,
    prior_intrinsics: FloatArray,
    freedom: Freedom,
) -> Problem:
    """Put the joint energy together.

    Args:
        state: See :func:`joint_state`.
        scene: Static observations and their noise.
        mesh: Rows and links of the moving points.
        moving: Their observations; those of tracks that the mesh does not have are left out.
        config: Stages 2 and 3, and the energy.
        prior_intrinsics: (1, 4) center of the intrinsics' prior.
        freedom: What is free besides points.
    """
    energy = energy_of(config)
    problem = bundle_adjustment_problem(
        state, scene.observations, scene.noise, config.bundle_adjustment, prior_intrinsics, freedom, energy,
        acceleration=scene.acceleration,
    )  # fmt: skip
    problem.fix(LOG_SCALE)
    problem.add(_observed_terms(mesh, moving, len(state[POSE]), config, energy))
    return problem.add(motion_terms(mesh, config.nonrigid, energy))


def _observed_terms(
    mesh: PointMesh, moving: MovingCues, num_frames: int, config: Config, energy: Energy
) -> list[FactorBatch]:
    """Return E_NR and the depth prior of moving points, on free cameras."""
    seen = moving.observations.select(np.isin(moving.observations.track, mesh.track))
    row = mesh.row[np.searchsorted(mesh.track, seen.track), seen.frame]
    stage, noise, terms = config.nonrigid, moving.noise, []
    if stage.reprojection:
        sigma = stage.reprojection_sigma_px or noise.reprojection_sigma_px
        weighed = energy.observed(sigma, seen.weight, stage.reprojection_kernel, seen.frame, num_frames)
        terms.append(joint_dynamic_reprojection(seen.frame, row, 0, uv=seen.uv, **weighed))
    known = np.isfinite(seen.depth)
    if stage.depth_prior and known.any():
        cue = seen.select(known)
        terms.append(
            joint_dynamic_depth_prior(
                cue.frame,
                row[known],
                cue.frame,
                depth=cue.depth,
                sigma=stage.depth_sigma or noise.depth_sigma,
                weight=cue.weight,
                kernel=kernel_of(stage.depth_kernel),
            )
        )
    return terms


def solve_joint(
    scene: StaticScene,
    motion: DynamicScene,
    moving: MovingCues,
    config: Config,
    prior_intrinsics: FloatArray,
    freedom: Freedom,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> tuple[StaticScene, DynamicScene]:
    """Minimize the joint energy from the end of the stages.

    As after stage 2, landmarks are then solved once more with frozen cameras where ``bundle_adjustment.structure`` is
    'refine', because the cameras' depth prior is wider than the cue's noise.

    Args:
        scene: End of stage 2; observations that disagree with it are dropped.
        motion: End of stage 3, with at least one trajectory.
        moving: What it was solved from.
        config: Stages 2 and 3, the energy, the solver.
        prior_intrinsics: (4,) the sequence's own intrinsics.
        freedom: Whether poses and intrinsics move.
        hooks: Progress and cancellation.
        run: What solves the declared stage.

    Returns:
        Both scenes, with the same tracks; covariances are those of stage 2.

    Raises:
        SolverError: If the system is singular.
    """
    dropped: dict[str, int] = {}
    static, observations = drop_outliers(scene.state(), scene.observations, config.bundle_adjustment, dropped)
    scene = replace(
        scene,
        landmarks=static[LANDMARK],
        landmark_track=static.numbers(LANDMARK)[:, 0],
        observations=observations,
        dropped=dropped,
    )
    mesh = mesh_of(motion, config)
    state = joint_state(scene, motion, mesh)
    problem = joint_problem(state, scene, mesh, moving, config, prior_intrinsics[None], freedom)
    state, summary = run(Stage("joint", problem, config.joint.solver), state, hooks)
    points = np.full_like(motion.points, np.nan)
    points[mesh.row >= 0] = state[DYNAMIC_POINT]
    return _static_end(scene, state, summary, config, hooks, run), replace(motion, points=points, solve=summary)


def _static_end(
    scene: StaticScene,
    state: State,
    summary: SolveSummary,
    config: Config,
    hooks: Hooks | None,
    run: StageRunner,
) -> StaticScene:
    stage, solves, noise = config.bundle_adjustment, [summary], scene.noise
    state = Cameras.of(state).state(state[LANDMARK], scene.landmark_track)
    if (
        stage.structure == "refine"
        and energy_of(config).is_likelihood
        and summary.termination is not Termination.CANCELLED
    ):
        state, noise, refined = refine_structure(
            state, scene.observations, noise, stage, hooks, run, kind="joint_structure"
        )
        solves += refined
    return replace(
        scene,
        cameras=Cameras.of(state),
        landmarks=state[LANDMARK],
        noise=noise,
        landmark_error=landmark_errors(state, scene.observations),
        solves=solves,
    )
