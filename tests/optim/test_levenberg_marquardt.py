"""The driver: parity with GTSAM's optimizer, descent, every named termination, guards, the summary."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from solve_samples import POINT_PRIOR, bundle, native_bundle, slot, trajectories

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorBatch, FactorType, Kernel, Slot
from uni4d_fg.factors.state import State
from uni4d_fg.factors.temporal_smoothness import velocity_smoothness
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, POSE
from uni4d_fg.optim.gaussian_graph import GraphObjective
from uni4d_fg.optim.gtsam_graph import to_gtsam
from uni4d_fg.optim.levenberg_marquardt import Hooks, minimize
from uni4d_fg.optim.objective import Step
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.schur import SchurObjective
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.optim.trajectory_cg import TrajectoryObjective

TIGHT = SolverConfig(max_iterations=200, relative_decrease=1e-14)


def gtsam_minimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(200)
    params.setRelativeErrorTol(1e-15)
    params.setAbsoluteErrorTol(1e-15)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def assert_descends(summary: SolveSummary) -> None:
    energies = [summary.initial_energy, *(record.energy for record in summary.iterations)]
    assert (np.diff(energies) < 0).all()
    np.testing.assert_allclose(summary.final_energy, energies[-1], rtol=1e-12)


@pytest.mark.parametrize("huber", [None, 1.0], ids=["quadratic", "huber"])
def test_bundle_adjustment_reaches_gtsams_minimum(rng: np.random.Generator, huber: float | None) -> None:
    kernel = Kernel() if huber is None else Kernel("huber", huber)
    problem, state = bundle(rng, kernel=kernel, outliers=0 if huber is None else 6)
    graph, values = native_bundle(problem, state, huber)
    np.testing.assert_allclose(graph.error(values), sum(problem.energies(state).values()), rtol=1e-9)
    expected = gtsam_minimum(graph, values)
    energy = graph.error(expected)

    native, native_summary = minimize(GraphObjective(graph), values, TIGHT)
    ours, summary = minimize(SchurObjective(problem, state, TIGHT), state, TIGHT)
    reference = state.with_values(expected)
    for solved, result in ((state.with_values(native), native_summary), (ours, summary)):
        np.testing.assert_allclose(result.final_energy, energy, rtol=1e-9)
        assert_descends(result)
        assert result.converged
        for group, scale in ((POSE, 1.0), (LANDMARK, 1.0), (INTRINSICS, 500.0)):
            np.testing.assert_allclose(solved[group], reference[group], atol=1e-6 * scale)
    assert summary.initial_energy > 5 * summary.final_energy


@pytest.mark.parametrize("ordering", ["colamd", "metis", "natural"])
def test_pose_graph_reaches_gtsams_minimum(rng: np.random.Generator, ordering: str) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.02, 0.02, 0.02, 0.05, 0.05, 0.05]))
    truth = [gtsam.Pose3.Expmap(np.array([0.0, 0.2 * i, 0.05 * i, 0.5 * i, 0.0, 0.3 * i])) for i in range(12)]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gtsam.PriorFactorPose3(gtsam.symbol("x", 0), truth[0], noise))
    for i, j in [(i, i + 1) for i in range(11)] + [(0, 5), (2, 9), (3, 11)]:
        measured = truth[i].between(truth[j]).retract(rng.normal(scale=0.02, size=6))
        graph.push_back(gtsam.BetweenFactorPose3(gtsam.symbol("x", i), gtsam.symbol("x", j), measured, noise))
    for i, pose in enumerate(truth):
        values.insert(gtsam.symbol("x", i), pose.retract(rng.normal(scale=0.1, size=6)))
    expected = gtsam_minimum(graph, values)
    solved, summary = minimize(GraphObjective(graph, ordering), values, TIGHT)
    np.testing.assert_allclose(summary.final_energy, graph.error(expected), rtol=1e-9)
    assert_descends(summary)
    for i in range(12):
        key = gtsam.symbol("x", i)
        np.testing.assert_allclose(solved.atPose3(key).matrix(), expected.atPose3(key).matrix(), atol=1e-6)


def test_custom_factors_reach_the_minimum_of_the_batches(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, num_poses=4, num_landmarks=10, kernel=Kernel("cauchy", 1.5), outliers=3)
    # Of a Cauchy kernel's several minima, the one near that of its convex cousin.
    convex = replace(problem, batches=(replace(problem.batches[0], kernel=Kernel("huber", 1.5)), *problem.batches[1:]))
    state, _ = minimize(SchurObjective(convex, state, TIGHT), state, TIGHT)
    ours, summary = minimize(SchurObjective(problem, state, TIGHT), state, TIGHT)
    graph, start = to_gtsam(problem, state, native=False)
    np.testing.assert_allclose(graph.error(start), summary.initial_energy, rtol=1e-12)
    # Reweighting and exact derivatives of the same kernel take other ways down: of several minima, into the same one
    # only from near it.
    near = ours.retract({v: 1e-3 * rng.normal(size=(len(ours[v]), v.dim)) for v in (POSE, LANDMARK)})
    _, start = to_gtsam(problem, near, native=False)
    values, reference = minimize(GraphObjective(graph), start, TIGHT)
    assert reference.initial_energy > reference.final_energy + 1.0
    np.testing.assert_allclose(summary.final_energy, reference.final_energy, rtol=1e-9)
    np.testing.assert_allclose(ours[POSE], state.with_values(values)[POSE], atol=1e-6)
    assert summary.initial_energy > 1.2 * summary.final_energy


def chain(count: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Points in a row, each tied to the next by a Python factor."""
    rows = np.arange(count)
    smooth = FactorBatch.create(velocity_smoothness, (slot(rows[:-1]), slot(rows[1:])), sigma=0.1)
    first = FactorBatch.create(POINT_PRIOR, (slot(rows[:1]),), {"measured": np.zeros((1, 3))})
    state = State({DYNAMIC_POINT: np.random.default_rng(0).normal(size=(count, 3))})
    problem = Problem((smooth, first), all_free(state, DYNAMIC_POINT))
    return to_gtsam(problem, state, native=False, stacked=False)


def test_cost_is_linear_in_the_number_of_custom_factors() -> None:
    config = SolverConfig(max_iterations=1)
    seconds = []
    for count in (150, 600):
        graph, values = chain(count)
        objective = GraphObjective(graph)
        minimize(objective, values, config)
        times = []
        for _ in range(3):
            began = time.process_time()  # of this process alone, whatever else the machine does
            minimize(objective, values, config)
            times.append(time.process_time() - began)
        seconds.append(min(times))
    assert seconds[1] / seconds[0] < 8.0, f"{seconds}: quadratic cost would be 16 times"


# --- terminations -------------------------------------------------------------------------------------------


def rosenbrock() -> tuple[Problem, State]:
    """A curved valley in two entries of one point; the third is held by a prior."""

    def residual(p: np.ndarray) -> np.ndarray:
        return np.stack([10 * (p[:, 1] - p[:, 0] ** 2), 1 - p[:, 0], p[:, 2]], axis=1)

    def linearize(p: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        j = np.zeros((len(p), 3, 3))
        j[:, 0, 0], j[:, 0, 1], j[:, 1, 0], j[:, 2, 2] = -20 * p[:, 0], 10, -1, 1
        return residual(p), [j]

    valley = FactorType("rosenbrock", (DYNAMIC_POINT,), {}, 3, residual, linearize, listed=False)
    state = State({DYNAMIC_POINT: np.array([[-1.2, 1.0, 0.5]])})
    return Problem(
        (FactorBatch.create(valley, (slot(np.zeros(1, dtype=np.int64)),)),), all_free(state, DYNAMIC_POINT)
    ), state


def solve_rosenbrock(hooks: Hooks | None = None, **options: float) -> tuple[State, SolveSummary]:
    problem, state = rosenbrock()
    config = SolverConfig(**{"max_iterations": 200, "relative_decrease": 1e-14, **options})
    return minimize(SchurObjective(problem, state, config, DYNAMIC_POINT), state, config, hooks=hooks)


def test_zero_energy() -> None:
    solved, summary = solve_rosenbrock(step_tolerance=0, gradient_tolerance=0)
    assert summary.termination in (Termination.ZERO_ENERGY, Termination.STEP)
    np.testing.assert_allclose(solved[DYNAMIC_POINT], [[1.0, 1.0, 0.0]], atol=1e-9)
    assert sum(record.rejected for record in summary.iterations) > 0, "the valley is curved: some steps overshoot"
    assert_descends(summary)
    problem, _ = rosenbrock()
    at_zero = State({DYNAMIC_POINT: np.array([[1.0, 1.0, 0.0]])})
    _, summary = minimize(SchurObjective(problem, at_zero, TIGHT, DYNAMIC_POINT), at_zero, TIGHT)
    assert summary.termination is Termination.ZERO_ENERGY
    assert summary.converged
    assert summary.iterations == ()


def test_gradient_below_tolerance() -> None:
    _, summary = solve_rosenbrock(gradient_tolerance=1e-3)
    assert summary.termination is Termination.GRADIENT
    assert summary.final_energy < 1e-5


def test_step_below_tolerance() -> None:
    _, summary = solve_rosenbrock(step_tolerance=1e-2, gradient_tolerance=0)
    assert summary.termination is Termination.STEP
    assert summary.converged


def test_relative_decrease_below_tolerance(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    config = SolverConfig(relative_decrease=1e-3)
    _, summary = minimize(SchurObjective(problem, state, config), state, config)
    assert summary.termination is Termination.RELATIVE_DECREASE
    before, after = (summary.iterations[i].energy for i in (-2, -1))
    assert (before - after) / before < 1e-3


def test_iteration_limit() -> None:
    _, summary = solve_rosenbrock(max_iterations=3)
    assert summary.termination is Termination.MAX_ITERATIONS
    assert len(summary.iterations) == 3
    assert not summary.converged


class Uphill:
    """An energy that every step raises although the model promises a decrease."""

    def energies(self, state: float) -> dict[str, float]:
        return {"wall": 1.0 + abs(state)}

    def retract(self, state: float, delta: float) -> float:
        return state + delta

    def linearize(self, state: float) -> Uphill:
        return self

    gradient_max = 1.0

    def solve(self, damping: float) -> Step:
        return Step(1.0 / damping, 1.0, 0.5)

    def diagnose(self, state: float) -> str:
        return ""


def test_damping_limit() -> None:
    state, summary = minimize(Uphill(), 0.0, SolverConfig(max_damping=1e4))
    assert summary.termination is Termination.DAMPING_LIMIT
    assert state == 0.0
    assert summary.final_energy == summary.initial_energy == 1.0
    assert not summary.converged


def test_a_trial_that_is_not_finite_is_rejected() -> None:
    class Cliff(Uphill):
        def energies(self, state: float) -> dict[str, float]:
            return {"cliff": float("nan") if state > 0.1 else 1.0 - state}

    state, summary = minimize(Cliff(), 0.0, SolverConfig(max_iterations=1))
    assert 0.0 < state <= 0.1
    assert summary.iterations[0].rejected > 0
    assert summary.final_energy < 1.0


def test_cancelled_returns_the_best_state_so_far() -> None:
    seen: list[tuple[str, int, float]] = []
    hooks = Hooks(on_iteration=lambda *report: seen.append(report), should_stop=lambda: len(seen) >= 4)
    solved, summary = solve_rosenbrock(hooks)
    assert summary.termination is Termination.CANCELLED
    assert [n for _, n, _ in seen] == [1, 2, 3, 4]
    assert [energy for _, _, energy in seen] == [record.energy for record in summary.iterations]
    problem, _ = rosenbrock()
    np.testing.assert_allclose(sum(problem.energies(solved).values()), summary.final_energy, rtol=1e-12)


def test_nothing_to_do(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    stage = Stage("idle", Problem(problem.batches, {POSE: np.zeros((5, 6), dtype=bool)}), SolverConfig())
    solved, summary = run_stage(stage, state)
    assert solved is state
    assert summary.termination is Termination.NOTHING_TO_DO
    assert summary.converged
    assert summary.initial_energies == summary.final_energies == problem.energies(state)


# --- guards -------------------------------------------------------------------------------------------------


def test_missing_cue_is_named(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    batch = problem.batches[0]
    uv = batch.data["uv"].copy()
    row = 9
    uv[row] = np.nan
    problem = replace(problem, batches=(replace(batch, data={"uv": uv}), *problem.batches[1:]))
    frame, landmark = int(batch.slots[0].rows[row]), int(batch.slots[1].rows[row])
    with pytest.raises(SolverError) as caught:
        minimize(SchurObjective(problem, state, TIGHT), state, TIGHT)
    for part in ("static_reprojection", f"camera pose, frame {frame}", f"landmark, track {10 + 3 * landmark}"):
        assert part in str(caught.value)


def test_missing_depth_is_named_by_the_trajectory_solver(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    batch = problem.batches[1]
    depth = batch.data["depth"].copy()
    depth[16] = np.nan
    broken = replace(batch, data={**batch.data, "depth": depth})
    problem = replace(problem, batches=(problem.batches[0], broken, *problem.batches[2:]))
    with pytest.raises(SolverError, match=r"depth_prior: .* dynamic point, track 20, frame 2"):
        minimize(TrajectoryObjective(problem, state, TIGHT), state, TIGHT)


def test_native_factor_that_is_not_finite_is_named() -> None:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    graph.push_back(gtsam.PriorFactorPoint3(gtsam.symbol("l", 4), np.zeros(3), noise))
    graph.push_back(gtsam.PriorFactorPoint3(gtsam.symbol("l", 5), np.full(3, np.nan), noise))
    for i in (4, 5):
        values.insert(gtsam.symbol("l", i), np.ones(3))
    with pytest.raises(SolverError, match="factor 1 on landmark, track 5 is not finite"):
        minimize(GraphObjective(graph), values, TIGHT)


@pytest.mark.parametrize(
    ("linearize", "message"),
    [
        (lambda p, measured: (p - measured, [np.zeros((len(p), 3, 2))]), r"Jacobian of dynamic_point is \(2, 3, 2\)"),
        (lambda p, measured: (p - measured, [np.zeros((len(p), 3, 3))] * 2), "2 Jacobians for 1 variables"),
        (lambda p, measured: ((p - measured)[:, :2], [np.zeros((len(p), 3, 3))]), r"residual is \(2, 2\)"),
    ],
    ids=["width", "count", "residual"],
)
def test_wrong_shapes_are_refused(linearize, message: str) -> None:
    state = State({DYNAMIC_POINT: np.ones((2, 3))})
    wrong = replace(POINT_PRIOR, linearize=linearize)
    batch = FactorBatch.create(wrong, (slot(np.arange(2)),), {"measured": np.zeros((2, 3))})
    problem = Problem((batch,), all_free(state, DYNAMIC_POINT))
    with pytest.raises(SolverError, match=f"point_prior: {message}"):
        minimize(TrajectoryObjective(problem, state, TIGHT), state, TIGHT)


def test_wrong_width_in_a_foreign_custom_factor_is_refused() -> None:
    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(np.eye(3)[:, :2])
        return values.atPoint3(this.keys()[0])

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    key = gtsam.symbol("l", 8)
    graph.push_back(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [key], error))
    values.insert(key, np.ones(3))
    with pytest.raises(SolverError, match="factor 0 on landmark, track 8 has 2 columns, not 3"):
        minimize(GraphObjective(graph), values, TIGHT)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigma": 0.0}, "sigma must be finite and positive"),
        ({"sigma": np.array([1.0, np.nan])}, "sigma must be finite and positive"),
        ({"weight": -1.0}, "weight must be finite and not negative"),
        ({"sigma": np.ones(3)}, "every array needs 2 rows"),
    ],
)
def test_bad_noise_is_refused(options: dict[str, float | np.ndarray], message: str) -> None:
    with pytest.raises(SolverError, match=message):
        FactorBatch.create(POINT_PRIOR, (slot(np.arange(2)),), {"measured": np.zeros((2, 3))}, **options)


def test_bad_slots_and_data_are_refused() -> None:
    measured = {"measured": np.zeros((2, 3))}
    with pytest.raises(SolverError, match="negative"):
        FactorBatch.create(POINT_PRIOR, (slot(np.array([0, -1])),), measured)
    with pytest.raises(SolverError, match="reads pose where the factor needs dynamic_point"):
        FactorBatch.create(POINT_PRIOR, (Slot(POSE, np.arange(2)),), measured)
    with pytest.raises(SolverError, match="2 slots for 1 variables"):
        FactorBatch.create(POINT_PRIOR, (slot(np.arange(2)),) * 2, measured)
    with pytest.raises(SolverError, match="needs data"):
        FactorBatch.create(POINT_PRIOR, (slot(np.arange(2)),), {})


# --- singular systems ---------------------------------------------------------------------------------------

FRAGILE = SolverConfig(initial_damping=1e-30, max_damping=1e-28, min_diagonal=1e-300)


def test_undetermined_pose_stays_still_thanks_to_the_damping_floor(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    reprojection = problem.batches[0]
    seen = reprojection.take(np.flatnonzero(reprojection.slots[0].rows != 3))
    problem = replace(problem, batches=(seen, *problem.batches[1:]))
    solved, summary = minimize(SchurObjective(problem, state, TIGHT), state, TIGHT)
    assert summary.converged
    np.testing.assert_array_equal(solved[POSE][3], state[POSE][3])
    with pytest.raises(SolverError, match=r"singular. Not determined: camera pose, frame 3 \(factors: none\)"):
        minimize(SchurObjective(problem, state, FRAGILE), state, FRAGILE)


def test_landmark_on_one_ray_is_named(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    reprojection, prior, intrinsics = problem.batches
    first = int(np.flatnonzero(reprojection.slots[1].rows == 6)[0])
    rows = np.flatnonzero(reprojection.slots[1].rows != 6)
    batches = (
        reprojection.take(np.sort(np.append(rows, first))),
        prior.take(np.flatnonzero(prior.slots[0].rows != 6)),
        intrinsics,
    )
    problem = replace(problem, batches=batches)
    message = SchurObjective(problem, state, TIGHT).diagnose(state)
    assert message.startswith("Not determined: landmark, track 28 (factors: static_reprojection).")
    _, summary = minimize(SchurObjective(problem, state, TIGHT), state, TIGHT)
    assert summary.converged
    graph, values = to_gtsam(problem, state)
    assert "landmark, track 28 (factors: " in GraphObjective(graph).diagnose(values)


def test_gauge_freedom_is_counted(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    fixed_intrinsics = {POSE: problem.free[POSE], LANDMARK: problem.free[LANDMARK]}
    problem = Problem(problem.batches[:1], fixed_intrinsics)
    message = SchurObjective(problem, state, TIGHT).diagnose(state)
    assert "free joint directions: 7" in message
    assert "camera pose, frame" in message
    anchored = {**fixed_intrinsics, POSE: fixed_intrinsics[POSE].copy()}
    anchored[POSE][0] = False
    message = SchurObjective(replace(problem, free=anchored), state, TIGHT).diagnose(state)
    assert "free joint directions: 1" in message
    graph, values = to_gtsam(problem, state)
    assert "No single variable" in GraphObjective(graph).diagnose(values)


def test_singular_graph_names_its_variable() -> None:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    graph.push_back(gtsam.BetweenFactorPoint3(gtsam.symbol("l", 0), gtsam.symbol("l", 1), np.ones(3), noise))
    for i in range(2):
        values.insert(gtsam.symbol("l", i), np.zeros(3))
    # Relative to a Hessian of 100, the smallest damping vanishes in the rounding.
    with pytest.raises(SolverError, match=r"solve: the linear system is singular\. No single variable"):
        minimize(GraphObjective(graph), values, FRAGILE)


def test_summary_is_plain_data(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, depth=True)
    _, summary = minimize(SchurObjective(problem, state, TIGHT), state, TIGHT, name="bundle")
    plain = json.loads(json.dumps(summary.to_dict(), allow_nan=False))
    assert plain["name"] == "bundle"
    assert plain["termination"].startswith("converged")
    assert set(plain["initial_energies"]) == {b.name for b in problem.batches}
    assert plain["final_energy"] == summary.final_energy
    assert set(plain["seconds"]) == {"linearize", "solve", "evaluate", "total"}
    assert len(plain["iterations"]) == len(summary.iterations)
