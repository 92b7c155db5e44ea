"""Systems that several threads share give each what a thread alone gets."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import test_pair_system as pairs
import test_trajectory_system as trajectories

from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, POSE

THREADS, CALLS = 6, 300


def test_one_trajectory_system() -> None:
    # Two points apart: what one thread's call leaves in shared arrays is not what another's needs.
    problem, state = trajectories.make_problem(3, [30] * 20, "huber", scrambled=False, behind=False)
    system = trajectories.system_of(problem, state)
    points = [state[DYNAMIC_POINT], state[DYNAMIC_POINT] + 0.3]
    vector = np.arange(3.0 * len(points[0]))
    energies = [system.energies(p) for p in points]
    gradients = [system.linearize(p)[0] for p in points]

    def call(number: int) -> None:
        which = number % 2
        np.testing.assert_array_equal(system.energies(points[which]), energies[which])
        gradient, failure = system.linearize(points[which])
        assert failure is None
        np.testing.assert_array_equal(gradient, gradients[which])
        # Of which linearization it is, only a thread that is alone can know.
        assert np.isfinite(system.multiply(vector)).all()
        assert np.isfinite(system.diagonal_blocks()).all()
        assert system.solve(1e-2, 1e-6, 1e32, 0.1, 5) is not None
        assert system.num_batches == len(problem.batches)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(call, range(CALLS)))


def test_batches_that_several_threads_add_are_all_there() -> None:
    problem, state = trajectories.make_problem(4, [9] * 6, "huber", scrambled=False, behind=False)
    batches = [problem.batches[0]] * 40
    system = trajectories._core.TrajectorySystem(np.ascontiguousarray(state.numbers(DYNAMIC_POINT)[:, 0]), 2)
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(lambda batch: trajectories.add(system, batch), batches))
        planned = [pool.submit(system.plan) for _ in range(THREADS)]
    assert sum(future.exception() is None for future in planned) == 1
    assert len(set(system.energies(state[DYNAMIC_POINT]).tolist())) == 1
    assert system.num_batches == len(batches)
    with pytest.raises(ValueError, match=r"no batch can be added after plan\(\)"):
        trajectories.add(system, batches[0])


def test_one_pair_system() -> None:
    batch, state = pairs.make_batch(np.random.default_rng(0), 4000, "huber", True)
    columns = np.arange(6 * pairs.NUM_POSES + 4)
    system = pairs.system_of(batch, columns, 2)
    arguments = (state[POSE], state[INTRINSICS][0])
    energy, (hessian, gradient) = system.energy(*arguments), system.linearize(*arguments)

    def call(_: int) -> None:
        assert system.energy(*arguments) == energy
        found, slope = system.linearize(*arguments)
        np.testing.assert_array_equal(found, hessian)
        np.testing.assert_array_equal(slope, gradient)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(call, range(CALLS)))
