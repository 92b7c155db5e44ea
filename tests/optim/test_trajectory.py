"""Conjugate gradients over trajectories against dense algebra and against GTSAM's elimination."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solve_samples import POINT_PRIOR, dense_jacobian, slot, trajectories

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorBatch, FactorType, Kernel, Slot
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, POSE
from uni4d_fg.optim import trajectory_cg
from uni4d_fg.optim.bands import BANDS, symmetric
from uni4d_fg.optim.gaussian_graph import GraphObjective
from uni4d_fg.optim.gtsam_graph import to_gtsam
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.trajectory_cg import TrajectoryObjective

EXACT = SolverConfig(cg_tolerance=1e-10, cg_max_iterations=5000, min_diagonal=1e-9)
DAMPING = 1e-3


def dense(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
    jacobian, r, _ = dense_jacobian(problem, state, [DYNAMIC_POINT])
    return jacobian.T @ jacobian, jacobian.T @ r


def with_prior(problem: Problem, state: State) -> Problem:
    """Add a term whose rows repeat and whose order is scrambled."""
    rows = np.array([5, 0, 5, 17, 3, 5])
    prior = FactorBatch.create(POINT_PRIOR, (slot(rows),), {"measured": state[DYNAMIC_POINT][rows] + 0.1}, sigma=0.3)
    return replace(problem, batches=(*problem.batches, prior))


@pytest.mark.parametrize("piece_rows", [8192, 7])
@pytest.mark.parametrize("threads", [1, 2])
def test_step_is_that_of_the_dense_system(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, piece_rows: int, threads: int
) -> None:
    monkeypatch.setattr(trajectory_cg, "_PIECE_ROWS", piece_rows)
    problem, state = trajectories(rng)
    problem = with_prior(problem, state)
    hessian, gradient = dense(problem, state)
    linearization = TrajectoryObjective(problem, state, EXACT, threads=threads).linearize(state)
    np.testing.assert_allclose(linearization.gradient, gradient, rtol=1e-10, atol=1e-10 * np.abs(gradient).max())
    assert linearization.gradient_max == np.abs(linearization.gradient).max()
    vector = rng.normal(size=len(gradient))
    np.testing.assert_allclose(
        linearization.multiply(vector), hessian @ vector, rtol=1e-10, atol=1e-12 * np.abs(hessian).max()
    )
    step = linearization.solve(DAMPING)
    assert step is not None
    expected = np.linalg.solve(hessian + DAMPING * np.diag(np.diag(hessian)), -gradient)
    np.testing.assert_allclose(step.delta, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(step.norm, np.linalg.norm(expected), rtol=1e-8)
    decrease = -(gradient @ expected) - 0.5 * expected @ hessian @ expected
    np.testing.assert_allclose(step.predicted_decrease, decrease, rtol=1e-8)


def test_preconditioner_is_the_block_of_every_track(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    problem = with_prior(problem, state)
    hessian, _ = dense(problem, state)
    track = np.repeat(state.numbers(DYNAMIC_POINT)[:, 0], 3)
    row = np.repeat(np.arange(len(state[DYNAMIC_POINT])), 3)
    expected = np.where((track[:, None] == track) & (np.abs(row[:, None] - row) <= 2), hessian, 0.0)
    assert np.count_nonzero(expected != hessian) > 0, "as-rigid-as-possible couples tracks"
    bands = TrajectoryObjective(problem, state, EXACT).linearize(state).bands
    np.testing.assert_allclose(symmetric(bands).toarray(), expected, rtol=1e-10, atol=1e-12 * hessian.max())


def test_one_track_on_its_own_needs_one_inner_step(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng, num_tracks=1, num_frames=20)
    step = TrajectoryObjective(problem, state, EXACT).linearize(state).solve(DAMPING)
    assert step is not None
    assert step.inner_iterations <= 2


@pytest.mark.parametrize("kernel", [Kernel(), Kernel("huber", 1.345), Kernel("cauchy", 2.0)], ids=lambda k: k.kind)
def test_same_minimum_as_gtsams_elimination(rng: np.random.Generator, kernel: Kernel) -> None:
    problem, state = trajectories(rng, kernel=kernel)
    config = SolverConfig(max_iterations=200, relative_decrease=1e-14, cg_tolerance=1e-6, cg_max_iterations=2000)
    ours, summary = minimize(TrajectoryObjective(problem, state, config), state, config)
    graph, start = to_gtsam(problem, state, native=False)
    values, reference = minimize(GraphObjective(graph), start, config)
    assert summary.initial_energy > 1.5 * summary.final_energy
    np.testing.assert_allclose(summary.initial_energy, reference.initial_energy, rtol=1e-10)
    np.testing.assert_allclose(summary.final_energy, reference.final_energy, rtol=1e-9)
    np.testing.assert_allclose(ours[DYNAMIC_POINT], state.with_values(values)[DYNAMIC_POINT], atol=1e-5)


def test_inexact_and_exact_inner_solves_reach_the_same_energy(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng, num_tracks=12, num_frames=10)
    energies = []
    for tolerance in (0.03, 1e-10):
        config = SolverConfig(relative_decrease=1e-10, max_iterations=100, cg_tolerance=tolerance)
        energies.append(minimize(TrajectoryObjective(problem, state, config), state, config)[1].final_energy)
    np.testing.assert_allclose(energies[0], energies[1], rtol=1e-7)


def test_energies_are_the_problems(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    energies = TrajectoryObjective(problem, state, EXACT).energies(state)
    for term, energy in problem.energies(state).items():
        np.testing.assert_allclose(energies[term], energy, rtol=1e-12)


def test_threads_and_repetition_change_no_bit(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng, num_tracks=30, num_frames=20)
    config = SolverConfig(max_iterations=5)
    solved = [
        minimize(TrajectoryObjective(problem, state, config, threads=threads), state, config)[0][DYNAMIC_POINT]
        for threads in (1, 2, 2)
    ]
    np.testing.assert_array_equal(solved[0], solved[1])
    np.testing.assert_array_equal(solved[0], solved[2])


def test_a_factor_that_reads_one_point_twice(rng: np.random.Generator) -> None:
    """Both slots' products fall on the same block: as when a link closes on itself."""
    state = State(
        {DYNAMIC_POINT: rng.normal(size=(8, 3))},
        {DYNAMIC_POINT: np.stack([np.repeat([0, 1], 4), np.tile(np.arange(4), 2)], axis=1)},
    )
    rows = [np.array([0, 0, 4]), np.array([4, 1, 6]), np.array([1, 1, 5]), np.array([6, 3, 4])]
    prior = FactorBatch.create(POINT_PRIOR, (slot(np.arange(8)),), {"measured": np.zeros((8, 3))})
    problem = Problem((prior, FactorBatch.create(arap, tuple(map(slot, rows)))), all_free(state, DYNAMIC_POINT))
    hessian, gradient = dense(problem, state)
    linearization = TrajectoryObjective(problem, state, EXACT).linearize(state)
    vector = rng.normal(size=24)
    np.testing.assert_allclose(linearization.multiply(vector), hessian @ vector, atol=1e-12)
    np.testing.assert_allclose(linearization.gradient, gradient, atol=1e-12)
    step = linearization.solve(DAMPING)
    assert step is not None
    expected = np.linalg.solve(hessian + DAMPING * np.diag(np.diag(hessian)), -gradient)
    np.testing.assert_allclose(step.delta, expected, atol=1e-9)


def test_coupling_beyond_the_bands_keeps_the_preconditioner_positive_definite(rng: np.random.Generator) -> None:
    def linearize(*points: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        n = len(points[0])
        return sum(points), [np.broadcast_to(np.eye(3), (n, 3, 3))] * 4

    total = FactorType("sum", (DYNAMIC_POINT,) * 4, {}, 3, lambda *points: sum(points), linearize, listed=False)
    state = State(
        {DYNAMIC_POINT: rng.normal(size=(4, 3))},
        {DYNAMIC_POINT: np.stack([np.zeros(4, dtype=np.int64), np.arange(4)], axis=1)},
    )
    batches = (
        FactorBatch.create(total, tuple(slot(np.array([i])) for i in range(4)), sigma=1e-3),
        FactorBatch.create(POINT_PRIOR, (slot(np.arange(4)),), {"measured": np.zeros((4, 3))}),
    )
    problem = Problem(batches, all_free(state, DYNAMIC_POINT))
    linearization = TrajectoryObjective(problem, state, EXACT).linearize(state)
    assert linearization.bands.shape == (BANDS, 12)
    assert (np.linalg.eigvalsh(symmetric(linearization.bands).toarray()) > 0).all()
    step = linearization.solve(1e-9)
    assert step is not None
    hessian, gradient = dense(problem, state)
    damped = hessian + 1e-9 * np.diag(np.diag(hessian))
    np.testing.assert_allclose(step.delta, np.linalg.solve(damped, -gradient), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", ["huber", "pseudo_huber", "cauchy", "norm"])
def test_the_curvature_of_kernels_shortens_the_end(rng: np.random.Generator, kind: str) -> None:
    problem, state = trajectories(rng, 12, 10, kernel=Kernel(kind, 0.3))  # type: ignore[arg-type]
    reweighted = SolverConfig(relative_decrease=1e-9, max_iterations=300)
    _, plain = minimize(TrajectoryObjective(problem, state, reweighted), state, reweighted)
    config = reweighted.model_copy(update={"kernel_curvature": 0.7})
    _, curved = minimize(TrajectoryObjective(problem, state, config), state, config)
    assert curved.converged
    assert len(curved.iterations) < 0.8 * len(plain.iterations)
    assert curved.final_energy <= plain.final_energy * (1.0 + 1e-7)


def test_frozen_points_and_other_groups_are_refused(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    free = {DYNAMIC_POINT: problem.free[DYNAMIC_POINT].copy()}
    free[DYNAMIC_POINT][3] = False
    with pytest.raises(SolverError, match="none can be frozen"):
        TrajectoryObjective(replace(problem, free=free), state, EXACT)
    one = np.zeros(1, dtype=np.int64)
    slots = (Slot(POSE, one), Slot(LANDMARK, one), Slot(INTRINSICS, one))
    other = FactorBatch.create(static_reprojection, slots, {"uv": np.zeros((1, 2))})
    with pytest.raises(SolverError, match="static_reprojection"):
        TrajectoryObjective(replace(problem, batches=(*problem.batches, other)), state, EXACT)


def test_a_point_without_factors_stays_and_is_named(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    lonely = 11
    keep = [np.logical_and.reduce([s.rows != lonely for s in b.slots]) for b in problem.batches]
    batches = tuple(b.take(np.flatnonzero(k)) for b, k in zip(problem.batches, keep, strict=True))
    problem = replace(problem, batches=batches)
    config = SolverConfig()
    objective = TrajectoryObjective(problem, state, config)
    solved, summary = minimize(objective, state, config)
    assert summary.converged
    np.testing.assert_array_equal(solved[DYNAMIC_POINT][lonely], state[DYNAMIC_POINT][lonely])
    assert "dynamic point, track 10, frame 4 (factors: none)" in objective.diagnose(state)


def test_a_point_on_a_ray_is_named(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    ray_only = replace(problem, batches=problem.batches[:1])
    message = TrajectoryObjective(ray_only, state, EXACT).diagnose(state)
    assert "dynamic point, track 0, frame 0 (factors: dynamic_reprojection)" in message
    assert "and 37 more" in message
    assert "No single variable" in TrajectoryObjective(problem, state, EXACT).diagnose(state)


def test_no_points() -> None:
    state = State({DYNAMIC_POINT: np.zeros((0, 3))})
    objective = TrajectoryObjective(Problem((), all_free(state, DYNAMIC_POINT)), state, EXACT)
    assert objective.linearize(state).gradient_max == 0.0
