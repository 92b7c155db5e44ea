"""Terms and variables that the package does not know, in the fast solvers, against a dense reference."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors import FactorBatch, Kernel, State, factor
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.depth_prior import static_depth_prior
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection
from uni4d_fg.factors.priors import intrinsics_prior
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness
from uni4d_fg.factors.variable_types import (
    DYNAMIC_POINT,
    INTRINSICS,
    LANDMARK,
    LOG_SCALE,
    POSE,
    point_variable,
    pose_variable,
)  # fmt: skip
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.optim.backend import Backend, make_objective
from uni4d_fg.optim.block import BlockObjective
from uni4d_fg.optim.cpp_schur import CppSchurObjective
from uni4d_fg.optim.cpp_trajectory import CppTrajectoryObjective
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective

FRAMES, LANDMARKS = 7, 60
K = np.array([400.0, 410.0, 160.0, 120.0])
CONFIG = SolverConfig(max_iterations=300, relative_decrease=1e-13, initial_damping=1e-6)

LEVER_ARM = point_variable("lever_arm", "a", ("sensor",))
MAP_POSE = pose_variable("map_pose", "M", ("map",))


@factor(POSE, data={"xyz": 3}, dim=3)
def camera_position(world_T_cam: Array, *, xyz: Array) -> Array:
    """A position prior without a Jacobian."""
    return world_T_cam[..., :3, 3] - xyz


@factor(MAP_POSE, POSE, LEVER_ARM, data={"xyz": 3}, dim=3)
def mapped_antenna(map_T_world: Array, world_T_cam: Array, lever_arm: Array, *, xyz: Array) -> Array:
    """Where an antenna on the camera is on a map: R_m (R_c a + t_c) + t_m - xyz."""
    point = (world_T_cam[..., :3, :3] @ lever_arm[..., None])[..., 0] + world_T_cam[..., :3, 3]
    return (map_T_world[..., :3, :3] @ point[..., None])[..., 0] + map_T_world[..., :3, 3] - xyz


@factor(LANDMARK, data={"height": ()}, dim=1)
def known_height(landmark: Array, *, height: Array) -> Array:
    """A landmark's height."""
    return (landmark[..., 1] - height)[..., None]


@factor(POSE, LANDMARK, MAP_POSE, data={"range": ()}, dim=1)
def measured_range(world_T_cam: Array, landmark: Array, map_T_world: Array, *, range: Array) -> Array:
    """A measured distance of camera and landmark, which a map's scale-free height stretches a little."""
    d = landmark - world_T_cam[..., :3, 3]
    return ((d * d).sum(-1) ** 0.5 - range + 0.1 * map_T_world[..., 2, 3])[..., None]


@factor(DYNAMIC_POINT, DYNAMIC_POINT, data={"step": 3}, dim=3)
def known_step(first: Array, second: Array, *, step: Array) -> Array:
    """A measured displacement between two moving points."""
    return second - first - step


def scene(rng: np.random.Generator, *, far: bool = False) -> tuple[Problem, State]:
    """A bundle adjustment with noise; every frame sees every landmark, or only near ones where ``far``."""
    poses = se3.se3_exp(np.linspace(0, 1, FRAMES)[:, None] * np.array([0.05, -0.1, 0.02, 0.6, 0.1, -0.1]))
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (LANDMARKS, 3))
    frame, row = (a.reshape(-1) for a in np.meshgrid(np.arange(FRAMES), np.arange(LANDMARKS), indexing="ij"))
    if far:
        keep = np.abs(frame - row % FRAMES) <= 1
        frame, row = frame[keep], row[keep]
    x = world_to_camera(poses[frame], points[row])
    uv = project(np.broadcast_to(K, (len(x), 4)), x) + rng.normal(scale=0.5, size=(len(x), 2))
    depth = x[:, 2] * np.exp(rng.normal(scale=0.02, size=len(x)))
    state = State(
        {
            POSE: se3.retract(poses, rng.normal(scale=5e-3, size=(FRAMES, 6)) * (np.arange(FRAMES) > 0)[:, None]),
            INTRINSICS: K[None] * 1.02,
            LOG_SCALE: np.zeros((FRAMES, 1)),
            LANDMARK: points + rng.normal(scale=0.02, size=points.shape),
        },
        {LANDMARK: 3 * np.arange(LANDMARKS) + 5},
    )
    problem = Problem.over(state).fix(POSE, rows=[0]).fix(INTRINSICS, entries=[2, 3]).eliminate(LANDMARK)
    problem.add(
        static_reprojection(frame, row, 0, uv=uv, sigma=0.5, kernel=Kernel("huber", 1.3)),
        static_depth_prior(frame, row, frame, depth=depth, sigma=0.02),
        intrinsics_prior(0, measured=K[None], sigma=5.0),
    )
    return problem, state


def dense_minimum(problem: Problem, state: State) -> State:
    """Gauss-Newton with Marquardt damping on the whole dense J: no elimination, no sparsity."""
    solved, _ = minimize(BlockObjective(problem, state, CONFIG), state, CONFIG)
    return solved


def with_foreign_factors(problem: Problem, state: State, kinds: Sequence[str]) -> State:
    """Add factors and variables of the given kinds; return the state with the new variables."""
    rng = np.random.default_rng(5)
    frames = np.arange(FRAMES)
    centers = state[POSE][:, :3, 3]
    if "variable" in kinds or "range" in kinds:
        state = State({**state.arrays, LEVER_ARM: np.zeros((1, 3)), MAP_POSE: np.eye(4)[None]}, state.index)
        problem.free = {
            **problem.free, LEVER_ARM: np.ones((1, 3), dtype=bool), MAP_POSE: np.ones((1, 6), dtype=bool),
        }  # fmt: skip
        xyz = centers + np.array([1.0, 2.0, 0.5]) + rng.normal(scale=0.02, size=(FRAMES, 3))
        problem.add(mapped_antenna(0, frames, 0, xyz=xyz, sigma=0.05))
        problem.add(gtsam.PriorFactorPoint3(LEVER_ARM.key(0), np.zeros(3), sigmas(0.1, 3)), state=state)
        problem.add(gtsam.PriorFactorPose3(MAP_POSE.key(0), gtsam.Pose3(), sigmas(3.0, 6)), state=state)
    if "prior" in kinds:
        problem.add(camera_position(frames, xyz=centers + 0.01, sigma=0.02, kernel=Kernel("cauchy", 2.0)))
    if "native" in kinds:
        step = gtsam.Pose3(se3.inverse(state[POSE][1]) @ state[POSE][3])
        problem.add(gtsam.BetweenFactorPose3(POSE.key(1), POSE.key(3), step, sigmas(0.01, 6)), state=state)
        problem.add(gtsam.GPSFactor(POSE.key(4), centers[4], sigmas(0.05, 3)), state=state)
    if "height" in kinds:
        rows = np.arange(0, LANDMARKS, 2)
        problem.add(known_height(rows, height=state[LANDMARK][rows, 1], sigma=0.05))
    if "range" in kinds:
        rows = np.arange(LANDMARKS)
        of_frame = rng.integers(0, FRAMES, LANDMARKS)  # frames that do not see the landmark among them
        distance = np.linalg.norm(state[LANDMARK] - centers[of_frame], axis=1)
        problem.add(measured_range(of_frame, rows, 0, range=distance, sigma=0.03))
    return state


def sigmas(sigma: float, dim: int) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Isotropic.Sigma(dim, sigma)


KINDS = [
    ("prior",),
    ("variable",),
    ("native",),
    ("height",),
    ("range",),
    ("prior", "variable", "native", "height", "range"),
]


@pytest.mark.parametrize("backend", ["cpp", "python"])
@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize("kinds", KINDS, ids="-".join)
def test_foreign_factors_solve_as_the_dense_reference(
    rng: np.random.Generator, kinds: tuple[str, ...], far: bool, backend: str
) -> None:
    if backend == "cpp":
        pytest.importorskip("uni4d_fg_cpp")
    problem, state = scene(rng, far=far)
    state = with_foreign_factors(problem, state, kinds)
    planned = make_objective(Backend(backend), problem, state, CONFIG)
    assert isinstance(planned.objective, CppSchurObjective if backend == "cpp" else SchurObjective)
    assert planned.why == ""
    first = planned.objective.linearize(state).solve(1e-3)
    dense = BlockObjective(problem, state, CONFIG)
    expected = dense.linearize(state).solve(1e-3)
    assert first is not None
    assert expected is not None
    assert first.predicted_decrease == pytest.approx(expected.predicted_decrease, rel=1e-9)
    moved, reference = planned.objective.retract(state, first.delta), dense.retract(state, expected.delta)
    for variable in state.arrays:
        np.testing.assert_allclose(moved[variable], reference[variable], rtol=1e-9, atol=1e-10)
    solved, summary = minimize(planned.objective, state, CONFIG)
    reference = dense_minimum(problem, state)
    assert summary.final_energy == pytest.approx(problem.energy(reference), rel=1e-8)
    for variable in state.arrays:
        np.testing.assert_allclose(solved[variable], reference[variable], atol=2e-4)
    terms = {term for part in planned.parts() for term in part.terms}
    assert terms == {batch.name for batch in problem.batches}


def test_a_factor_on_two_landmarks_goes_to_the_generic_solver_and_says_so(rng: np.random.Generator) -> None:
    problem, state = scene(rng)

    @factor(LANDMARK, LANDMARK, data={"distance": ()}, dim=1, name="landmark_distance")
    def landmark_distance(first: Array, second: Array, *, distance: Array) -> Array:
        return (((first - second) ** 2).sum(-1) ** 0.5 - distance)[..., None]

    a, b = np.arange(0, 20, 2), np.arange(1, 21, 2)
    measured = np.linalg.norm(state[LANDMARK][a] - state[LANDMARK][b], axis=1)
    problem.add(landmark_distance(a, b, distance=measured, sigma=0.01))
    planned = make_objective(Backend("python"), problem, state, CONFIG)
    assert isinstance(planned.objective, BlockObjective)
    assert "reads two landmark variables" in planned.parts()[0].why
    solved, _ = minimize(planned.objective, state, CONFIG)
    assert problem.energy(solved) == pytest.approx(problem.energy(dense_minimum(problem, state)), rel=1e-9)


def moving(rng: np.random.Generator) -> tuple[Problem, State]:
    """Moving points of several tracks, linked as stage 3 links them, and steps across tracks and frames."""
    tracks, frames = 12, 9
    row = np.arange(tracks * frames).reshape(tracks, frames)
    points = rng.uniform([-1, -1, 3], [1, 1, 4], (tracks, 1, 3)) + np.linspace(0, 1, frames)[None, :, None] * 0.3
    truth = points.reshape(-1, 3)
    number = np.stack([np.repeat(np.arange(tracks), frames), np.tile(np.arange(frames), tracks)], axis=1)
    state = State({DYNAMIC_POINT: truth + rng.normal(scale=0.02, size=truth.shape)}, {DYNAMIC_POINT: number})
    pose = np.broadcast_to(np.eye(4), (len(truth), 4, 4))
    intrinsics = np.broadcast_to(K, (len(truth), 4))
    uv = project(intrinsics, truth) + rng.normal(scale=0.5, size=(len(truth), 2))
    problem = Problem.over(state).add(
        dynamic_reprojection(row.reshape(-1), uv=uv, world_T_cam=pose, intrinsics=intrinsics, sigma=0.5),
        acceleration_smoothness(*(row[:, i : frames - 2 + i].reshape(-1) for i in range(3)), sigma=0.01),
        arap(row[:-1, :-1].ravel(), row[1:, :-1].ravel(), row[:-1, 1:].ravel(), row[1:, 1:].ravel(), sigma=0.01),
    )
    first, second = rng.integers(0, len(truth), (2, 200))
    problem.add(known_step(first, second, step=truth[second] - truth[first], sigma=0.02, kernel=Kernel("huber", 1.0)))
    return problem, state


@pytest.mark.parametrize("backend", ["cpp", "python"])
def test_foreign_factors_on_moving_points(rng: np.random.Generator, backend: str) -> None:
    if backend == "cpp":
        pytest.importorskip("uni4d_fg_cpp")
    problem, state = moving(rng)
    exact = CONFIG.model_copy(update={"cg_tolerance": 1e-12, "cg_max_iterations": 2000})
    planned = make_objective(Backend(backend), problem, state, exact)
    if backend == "cpp":
        assert isinstance(planned.objective, CppTrajectoryObjective)
        assert planned.parts()[1].terms == ("known_step",)
    step = planned.objective.linearize(state).solve(1e-3)
    dense = BlockObjective(problem, state, exact)
    expected = dense.linearize(state).solve(1e-3)
    assert step is not None
    assert expected is not None
    np.testing.assert_allclose(np.asarray(step.delta), expected.delta, atol=1e-6)
    solved, _ = minimize(planned.objective, state, exact)
    np.testing.assert_allclose(solved[DYNAMIC_POINT], dense_minimum(problem, state)[DYNAMIC_POINT], atol=1e-5)


def test_conjugate_gradients_of_the_generic_solver_find_the_dense_step(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, state = scene(rng)
    state = with_foreign_factors(problem, state, ("prior", "variable", "native", "height", "range"))
    points, moved = moving(rng)
    state = State({**state.arrays, **moved.arrays}, {**state.index, **moved.index})
    problem.free = {**problem.free, **points.free}
    problem.batches = (*problem.batches, *points.batches)
    dense = BlockObjective(problem, state, CONFIG).linearize(state).solve(1e-3)
    monkeypatch.setattr("uni4d_fg.optim.block._EXACT_COLUMNS", 0)
    monkeypatch.setattr("uni4d_fg.optim.block_preconditioner._MOST_CORE", 60)
    tight = CONFIG.model_copy(update={"cg_tolerance": 1e-12, "cg_max_iterations": 3000})
    objective = BlockObjective(problem, state, tight)
    assert objective.parts_of_columns is not None
    assert len(objective.parts_of_columns.chains) == 1
    assert len(objective.parts_of_columns.points) == LANDMARKS
    step = objective.linearize(state).solve(1e-3)
    assert step is not None
    assert dense is not None
    np.testing.assert_allclose(step.delta, dense.delta, atol=1e-7)
    assert step.inner_iterations < 120


def test_a_batch_knows_its_variables(rng: np.random.Generator) -> None:
    _, state = scene(rng)
    batch: FactorBatch = camera_position(np.arange(3), xyz=np.zeros((3, 3)), sigma=2.0)
    values: FloatArray = state[POSE][:3, :3, 3]
    assert batch.energy(state) == pytest.approx(0.5 * np.sum((values / 2.0) ** 2))
    assert batch.describe_row(1, state) == "camera pose, frame 1"
