"""The landmark Schur complement against dense normal equations built from full Jacobians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solve_samples import bundle, dense_jacobian, free_mask, pair_terms, slot

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorBatch, Kernel, VariableType
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim import chunks
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.schur import SchurObjective

CONFIG = SolverConfig(min_diagonal=1e-9)
DAMPING = 1e-3


def dense_system(
    problem: Problem, state: State, groups: list[VariableType]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the damped Hessian over the free columns, the gradient, and those columns."""
    jacobian, r, _ = dense_jacobian(problem, state, groups)
    free = np.flatnonzero(free_mask(problem, state, groups))
    j = jacobian[:, free]
    hessian = j.T @ j
    damped = hessian + DAMPING * np.diag(np.clip(np.diag(hessian), CONFIG.min_diagonal, CONFIG.max_diagonal))
    return damped, j.T @ r, free


def assert_step_is_dense(problem: Problem, state: State, eliminate: VariableType | None = LANDMARK, **kwargs) -> None:
    groups = [g for g in problem.free if problem.is_free(g)]
    damped, gradient, free = dense_system(problem, state, groups)
    objective = SchurObjective(problem, state, CONFIG, eliminate, **kwargs)
    linearization = objective.linearize(state)
    step = linearization.solve(DAMPING)
    assert step is not None
    expected = np.zeros(sum(len(state[g]) * g.dim for g in groups))
    expected[free] = np.linalg.solve(damped, -gradient)
    ours = np.concatenate([step.delta[g].reshape(-1) for g in groups])
    np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(step.norm, np.linalg.norm(expected), rtol=1e-9)
    d = expected[free]
    undamped = damped - DAMPING * np.diag(np.clip(np.diag(damped) / (1 + DAMPING), 1e-9, None))
    np.testing.assert_allclose(step.predicted_decrease, -(gradient @ d) - 0.5 * d @ undamped @ d, rtol=1e-6)
    np.testing.assert_allclose(linearization.gradient_max, np.abs(gradient).max(), rtol=1e-9)


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("per_chunk", [512, 5])
def test_step_is_that_of_the_dense_system(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, depth: bool, per_chunk: int
) -> None:
    monkeypatch.setattr(chunks, "_CHUNK_LANDMARKS", per_chunk)
    monkeypatch.setattr(chunks, "_CHUNK_ROWS", 7)
    problem, state = bundle(rng, kernel=Kernel("huber", 1.0), outliers=8, depth=depth)
    assert_step_is_dense(problem, state)


def test_reduced_system_is_the_schur_complement(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, depth=True)
    groups = [POSE, INTRINSICS, LOG_SCALE, LANDMARK]
    damped, gradient, _ = dense_system(problem, state, groups)
    n = len(damped) - 3 * len(state[LANDMARK])
    v = np.linalg.inv(damped[n:, n:])
    objective = SchurObjective(problem, state, CONFIG)
    reduced = objective.linearize(state).reduced(DAMPING)
    assert reduced is not None
    order = np.concatenate([objective.layout.columns(g, np.arange(len(state[g]))).reshape(-1) for g in groups[:3]])
    schur, rhs = reduced[0][np.ix_(order, order)], reduced[1][order]
    expected = damped[:n, :n] - damped[:n, n:] @ v @ damped[n:, :n]
    np.testing.assert_allclose(schur, expected, rtol=1e-9, atol=1e-12 * np.abs(damped).max())
    np.testing.assert_allclose(rhs, -gradient[:n] + damped[:n, n:] @ v @ gradient[n:], rtol=1e-8, atol=1e-4)


def test_frozen_rows_and_entries_do_not_move(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, depth=True)
    free = {g: mask.copy() for g, mask in problem.free.items()}
    free[POSE][[0, 3]] = False
    free[INTRINSICS][0, 2:] = False
    free[LANDMARK][[2, 5, 11]] = False
    free[LOG_SCALE][1] = False
    problem = replace(problem, free=free)
    assert_step_is_dense(problem, state)
    step = SchurObjective(problem, state, CONFIG).linearize(state).solve(DAMPING)
    assert step is not None
    for group, mask in free.items():
        assert (step.delta[group][~mask] == 0.0).all()
    moved = state.retract(step.delta)
    np.testing.assert_array_equal(moved[POSE][[0, 3]], state[POSE][[0, 3]])


@pytest.mark.parametrize("frozen", [[POSE], [INTRINSICS], [LANDMARK], [POSE, INTRINSICS]])
def test_frozen_groups(rng: np.random.Generator, frozen: list[VariableType]) -> None:
    problem, state = bundle(rng)
    free = {g: m for g, m in problem.free.items() if g not in frozen}
    assert_step_is_dense(replace(problem, free=free), state)


@pytest.mark.parametrize("same", [False, True])
def test_factors_that_read_two_poses(rng: np.random.Generator, same: bool) -> None:
    problem, state = bundle(rng, num_poses=6)
    problem = replace(problem, batches=(*problem.batches, pair_terms(rng, 6, 40, same)))
    assert_step_is_dense(problem, state)


@pytest.mark.parametrize("same", [False, True])
def test_nothing_to_eliminate(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, same: bool) -> None:
    monkeypatch.setattr(chunks, "_CHUNK_ROWS", 9)
    _, state = bundle(rng, num_poses=6)
    free = all_free(state, POSE, INTRINSICS)
    free[POSE][0] = False
    problem = Problem((pair_terms(rng, 6, 40, same),), free)
    assert_step_is_dense(problem, state, None)


def test_energies_are_the_problems(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "_CHUNK_LANDMARKS", 4)
    problem, state = bundle(rng, depth=True)
    everything = problem.free
    some = everything[LANDMARK].copy()
    some[::3] = False
    for free in (
        everything,
        {LANDMARK: everything[LANDMARK]},
        {LANDMARK: some},
        {LANDMARK: some, POSE: everything[POSE]},
        {INTRINSICS: everything[INTRINSICS]},
    ):
        partly = replace(problem, free=free)
        energies = SchurObjective(partly, state, CONFIG).energies(state)
        expected = partly.energies(state)
        assert set(energies) == set(expected)
        for term, energy in expected.items():
            np.testing.assert_allclose(energies[term], energy, rtol=1e-12)


def test_result_does_not_depend_on_the_number_of_threads(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks, "_CHUNK_LANDMARKS", 100)
    problem, state = bundle(rng, num_poses=20, num_landmarks=800, depth=True)
    config = SolverConfig(max_iterations=4)
    results = []
    for threads in (1, 2):
        solved, summary = minimize(SchurObjective(problem, state, config, threads=threads), state, config)
        results.append((solved, summary))
    for group in state.arrays:
        np.testing.assert_array_equal(results[0][0][group], results[1][0][group])
    assert [r.energy for r in results[0][1].iterations] == [r.energy for r in results[1][1].iterations]


def test_a_landmark_nobody_sees_stays_where_it_is(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    reprojection, prior, intrinsics = problem.batches
    unseen = 5
    batches = tuple(
        b.take(np.flatnonzero(next(s.rows for s in b.slots if s.variable == LANDMARK) != unseen))
        for b in (reprojection, prior)
    )
    problem = replace(problem, batches=(*batches, intrinsics))
    solved, summary = minimize(SchurObjective(problem, state, CONFIG), state, CONFIG)
    assert summary.converged
    np.testing.assert_array_equal(solved[LANDMARK][unseen], state[LANDMARK][unseen])
    message = SchurObjective(problem, state, CONFIG).diagnose(state)
    assert "landmark, track 25 (factors: none)" in message


def test_factors_on_two_eliminated_points_are_refused(rng: np.random.Generator) -> None:
    state = State({DYNAMIC_POINT: rng.normal(size=(4, 3))})
    rows = [np.array([i]) for i in range(4)]
    problem = Problem((FactorBatch.create(arap, tuple(map(slot, rows))),), all_free(state, DYNAMIC_POINT))
    with pytest.raises(SolverError, match="arap: reads several dynamic_point"):
        SchurObjective(problem, state, CONFIG, DYNAMIC_POINT)
