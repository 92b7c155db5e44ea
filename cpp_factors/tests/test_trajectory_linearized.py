"""Factors that come linearized to the system of moving points, against dense J^T J."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_trajectory_system import EXACT, KERNELS, add, assert_close, make_problem
from uni4d_fg_cpp import _core

from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.trajectory_cg import TrajectoryObjective

BOUNDS = (EXACT.min_diagonal, EXACT.max_diagonal)


@dataclass
class Linearized:
    """A batch of linear factors: rows (N, slots), residual (N, dim) and Jacobians (N, dim, slots, 3)."""

    rows: np.ndarray
    residual: np.ndarray
    jacobians: np.ndarray

    @classmethod
    def random(cls, rng: np.random.Generator, rows: np.ndarray, dim: int) -> Linearized:
        shape = (len(rows), dim)
        return cls(rows, rng.normal(size=shape), rng.normal(size=(*shape, rows.shape[1], 3)))

    def add_to(self, system: _core.TrajectorySystem) -> int:
        index: int = system.add_linearized(
            rows=[np.ascontiguousarray(self.rows[:, s]) for s in range(self.rows.shape[1])], dim=self.residual.shape[1]
        )
        return index

    def dense(self, num_points: int) -> np.ndarray:
        """Return J (N dim, 3 P); slots of one row add up."""
        out = np.zeros((*self.residual.shape, num_points, 3))
        for n, rows in enumerate(self.rows):
            for slot, row in enumerate(rows):
                out[n, :, row] += self.jacobians[n, :, slot]
        return out.reshape(-1, 3 * num_points)


def make_system(
    problem: Problem, state: State, batches: list[Linearized], threads: int = 2
) -> tuple[_core.TrajectorySystem, list[int]]:
    """Return a planned system with the batches among the others, and their indices."""
    system = _core.TrajectorySystem(np.ascontiguousarray(state.numbers(DYNAMIC_POINT)[:, 0]), threads)
    indices = [batches[0].add_to(system)] if batches else []
    for batch in problem.batches:
        add(system, batch)
    indices += [batch.add_to(system) for batch in batches[1:]]
    system.plan()
    return system, indices


def set_all(system: _core.TrajectorySystem, indices: list[int], batches: list[Linearized]) -> None:
    for index, batch in zip(indices, batches, strict=True):
        system.set_linearized(index, batch.residual, batch.jacobians)


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=6),
    kernel=st.sampled_from(KERNELS),
    scrambled=st.booleans(),
    shapes=st.lists(st.tuples(st.integers(1, 8), st.integers(1, 16), st.integers(0, 12)), min_size=1, max_size=3),
    curvature=st.sampled_from((0.0, 0.6)),
)
def test_parity_with_dense_algebra(
    seed: int,
    lengths: list[int],
    kernel: str,
    scrambled: bool,
    shapes: list[tuple[int, int, int]],
    curvature: float,
) -> None:
    """Factors of 1 to 8 slots on any points, some twice in one factor, together with all other families."""
    rng = np.random.default_rng(seed)
    problem, state = make_problem(seed, lengths, kernel, scrambled=scrambled, behind=False)
    points = state[DYNAMIC_POINT]
    count = len(points)
    batches = [Linearized.random(rng, rng.integers(0, count, (n, slots)), dim) for slots, dim, n in shapes]
    system, indices = make_system(problem, state, batches)
    assert indices == [0, *range(1 + len(problem.batches), len(batches) + len(problem.batches))]
    set_all(system, indices, batches)
    gradient, failure = system.linearize(points, curvature)
    assert failure is None
    energies = system.energies(points)
    assert (energies[indices] == 0.0).all()
    np.testing.assert_allclose(np.delete(energies, indices), [b.energy(state) for b in problem.batches], rtol=1e-11)

    config = EXACT.model_copy(update={"kernel_curvature": curvature})
    reference = TrajectoryObjective(problem, state, config, threads=1).linearize_curved(state)
    jacobian = np.concatenate([batch.dense(count) for batch in batches])
    hessian = np.stack([reference.multiply(unit) for unit in np.eye(3 * count)], axis=1) + jacobian.T @ jacobian
    residual = np.concatenate([batch.residual.reshape(-1) for batch in batches])
    expected_gradient = reference.gradient + jacobian.T @ residual
    assert_close(gradient, expected_gradient, 1e-10)
    vector = rng.normal(size=3 * count)
    assert_close(system.multiply(vector), hessian @ vector, 1e-10)
    blocks = hessian.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]
    assert_close(system.diagonal_blocks(), blocks, 1e-10)

    damping = np.diag(0.1 * np.clip(np.diag(hessian), *BOUNDS))
    delta = np.linalg.solve(hessian + damping, -expected_gradient)
    step = system.solve(0.1, *BOUNDS, 1e-12, 5000)
    assert step is not None, "the preconditioner is positive definite"
    assert_close(step[0], delta, 1e-7)
    assert step[1] == pytest.approx(np.linalg.norm(delta), rel=1e-8)
    decrease = -(expected_gradient @ delta + 0.5 * delta @ hessian @ delta)
    assert step[2] == pytest.approx(decrease, rel=1e-8)


def test_factors_within_a_track_and_reach_two_are_preconditioned_exactly() -> None:
    """Conjugate gradients need one step where the preconditioner is the matrix, up to its single precision."""
    rng = np.random.default_rng(0)
    tracks, length = 8, 40
    count = tracks * length
    first = np.arange(count)[np.arange(count) % length < length - 2]
    inside = Linearized.random(rng, np.stack([first, first + 2, first + 1], axis=1), 4)
    across = Linearized.random(rng, rng.integers(0, count, (60, 2)), 1)
    iterations = []
    for batches in ([inside], [inside, across]):
        system = _core.TrajectorySystem(np.repeat(np.arange(tracks), length), 2)
        indices = [batch.add_to(system) for batch in batches]
        system.plan()
        set_all(system, indices, batches)
        system.linearize(np.zeros((count, 3)))
        delta, _, _, steps = system.solve(1e-2, *BOUNDS, 1e-5, 1000)
        jacobian = np.concatenate([batch.dense(count) for batch in batches])
        residual = np.concatenate([batch.residual.reshape(-1) for batch in batches])
        hessian = jacobian.T @ jacobian
        damped = hessian + np.diag(1e-2 * np.clip(np.diag(hessian), *BOUNDS))
        assert_close(delta, np.linalg.solve(damped, -jacobian.T @ residual), 1e-4)
        iterations.append(steps)
    assert iterations[0] <= 2
    assert iterations[1] > iterations[0]


def test_every_number_of_threads_gives_the_same_bits() -> None:
    problem, state = make_problem(3, [60] * 40, "huber", scrambled=False, behind=False)
    points = state[DYNAMIC_POINT]
    results = []
    for threads in (1, 2, 3, 2):
        rng = np.random.default_rng(1)
        batches = [Linearized.random(rng, rng.integers(0, len(points), (500, slots)), 3) for slots in (1, 5)]
        system, indices = make_system(problem, state, batches, threads)
        set_all(system, indices, batches)
        gradient, _ = system.linearize(points)
        product = system.multiply(rng.normal(size=3 * len(points)))
        delta, *rest = system.solve(1e-3, *BOUNDS, 1e-3, 200)
        results.append((gradient, product, system.diagonal_blocks(), delta, np.array(rest)))
    for other in results[1:]:
        for mine, theirs in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_new_values_and_weights_need_no_new_plan() -> None:
    problem, state = make_problem(4, [9, 3, 7, 8], "huber", scrambled=False, behind=False)
    points, rng = state[DYNAMIC_POINT], np.random.default_rng(2)
    rows = rng.integers(0, len(points), (6, 3))
    old, new = Linearized.random(rng, rows, 2), Linearized.random(rng, rows, 2)
    system, indices = make_system(problem, state, [old])
    with pytest.raises(ValueError, match=r"batch 0: call set_linearized\(\) before each linearize\(\)"):
        system.linearize(points)
    set_all(system, indices, [old])
    system.linearize(points)
    with pytest.raises(ValueError, match=r"batch 0: call set_linearized\(\) before each linearize\(\)"):
        system.linearize(points)
    set_all(system, indices, [new])
    with pytest.raises(ValueError, match=r"linearize\(\) must succeed before solve\(\)"):
        system.solve(1e-3, *BOUNDS, 0.1, 10)
    gradient, _ = system.linearize(points)
    fresh, _ = make_system(problem, state, [new])
    set_all(fresh, indices, [new])
    np.testing.assert_array_equal(gradient, fresh.linearize(points)[0])
    # Weights and kernels are in the arrays already.
    system.reweight(0, np.full(6, 7.0), 1, 0.1)
    set_all(system, indices, [new])
    np.testing.assert_array_equal(gradient, system.linearize(points)[0])


def test_what_is_refused() -> None:
    system = _core.TrajectorySystem(np.repeat(np.arange(3), 5))
    one = np.zeros(1, dtype=np.int64)
    for rows in ([], [one] * 9):
        with pytest.raises(ValueError, match="rows: expected 1 to 8 arrays, one per slot, got"):
            system.add_linearized(rows, 1)
    for dim in (0, 17, -1):
        with pytest.raises(ValueError, match="dim: expected 1 to 16, got"):
            system.add_linearized([one], dim)
    with pytest.raises(ValueError, match=r"rows\[1\]: entry 0 is 15, outside \[0, 15\)"):
        system.add_linearized([one, one + 15], 1)
    assert system.add_linearized([one, one + 1], 3) == 0
    noise = {"sigma": np.ones(1), "weight": np.ones(1), "kernel": 0, "threshold": 1.0}
    system.add_smoothness(rows=[one, one + 1], **noise)
    residual, jacobians = np.zeros((1, 3)), np.zeros((1, 3, 2, 3))
    with pytest.raises(ValueError, match=r"call plan\(\) first"):
        system.set_linearized(0, residual, jacobians)
    system.plan()
    with pytest.raises(ValueError, match=r"no batch can be added after plan\(\)"):
        system.add_linearized([one], 1)
    for index in (-1, 1, 2):
        with pytest.raises(ValueError, match=rf"index: {index} is no batch of add_linearized\(\)"):
            system.set_linearized(index, residual, jacobians)
    with pytest.raises(ValueError, match=r"residual: expected float64 \(1, 3\)"):
        system.set_linearized(0, np.zeros((1, 2)), jacobians)
    with pytest.raises(ValueError, match=r"jacobians: expected float64 \(1, 3, 2, 3\)"):
        system.set_linearized(0, residual, np.zeros((1, 3, 6)))
    with pytest.raises(ValueError, match=r"jacobians: every value must be finite"):
        system.set_linearized(0, residual, np.full((1, 3, 2, 3), np.inf))
