"""Points that go to their own minima while everything else rests: in NumPy, and the C++ twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solve_samples import bundle

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors import FactorBatch, Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.optim.landmark_steps import settle_points
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective

CONFIG = SolverConfig(min_diagonal=1e-9, landmark_steps=60)
KERNELS = [
    Kernel(), Kernel("huber", 1.0), Kernel("pseudo_huber", 1.0), Kernel("cauchy", 2.0), Kernel("norm", 0.5),
]  # fmt: skip


def structure(kernel: Kernel, depth: bool = True) -> tuple[Problem, State]:
    """Landmarks, off by decimeters, and log-scales under resting cameras; landmark 0 rests too."""
    rng = np.random.default_rng(4)
    problem, state = bundle(rng, 8, 200, kernel=kernel, outliers=30, depth=depth)
    batches = tuple(b for b in problem.batches if b.name != "landmark_prior")
    landmarks = state[LANDMARK] + rng.normal(scale=0.1, size=state[LANDMARK].shape)
    still = Problem(batches, problem.free, LANDMARK).fix(POSE).fix(INTRINSICS).fix(LANDMARK, rows=[0])
    return still, state.replace({LANDMARK: landmarks})


def energy_of_each(batches: tuple[FactorBatch, ...], state: State) -> np.ndarray:
    out = np.zeros(len(state[LANDMARK]))
    for batch in batches:
        for slot in batch.slots:
            if slot.variable is LANDMARK:
                np.add.at(out, slot.rows, batch.weight * batch.kernel.rho(batch.squared_norm(state)))
    return out


def gradient_of_each(batches: tuple[FactorBatch, ...], state: State) -> np.ndarray:
    out = np.zeros(state[LANDMARK].shape)
    for batch in batches:
        r, jacobians = batch.linearize(state)
        for slot, jacobian in zip(batch.slots, jacobians, strict=True):
            if slot.variable is LANDMARK:
                np.add.at(out, slot.rows, np.einsum("nda,nd->na", jacobian, r))
    return out


def settled(problem: Problem, state: State, config: SolverConfig = CONFIG) -> State:
    return settle_points(problem.batches, state, LANDMARK, problem.free[LANDMARK].all(axis=1), config)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.kind)
def test_every_point_goes_to_a_minimum_of_its_own(kernel: Kernel) -> None:
    problem, state = structure(kernel)
    after = settled(problem, state)
    before, now = (energy_of_each(problem.batches, s) for s in (state, after))
    assert (now[1:] < before[1:]).all()
    np.testing.assert_array_equal(after[LANDMARK][0], state[LANDMARK][0])
    slopes = [np.linalg.norm(gradient_of_each(problem.batches, s)[1:], axis=1) for s in (state, after)]
    assert np.quantile(slopes[1] / slopes[0], 0.98) < 1e-3
    few = settled(problem, state, CONFIG.model_copy(update={"landmark_steps": 3}))
    assert (energy_of_each(problem.batches, few) <= before).all()


@pytest.mark.parametrize("depth", [False, True], ids=["reprojection", "depth"])
@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.kind)
def test_the_extension_takes_the_same_steps(kernel: Kernel, depth: bool) -> None:
    pytest.importorskip("uni4d_fg_cpp")
    from uni4d_fg.optim.cpp_schur import CppSchurObjective

    problem, state = structure(kernel, depth)
    nothing = {v: np.zeros((len(state[v]), v.dim)) for v in problem.free}
    for steps in (1, 4, 60):
        config = CONFIG.model_copy(update={"landmark_steps": steps})
        slow = settled(problem, state, config)[LANDMARK]
        by_threads = [
            CppSchurObjective(problem, state, config, threads).retract(state, nothing)[LANDMARK] for threads in (1, 2)
        ]
        np.testing.assert_array_equal(*by_threads)
        # A step that lowers the energy by what is lost in rounding may be taken by one alone.
        tolerance = 1e-9 if steps < 60 else 1e-5
        np.testing.assert_allclose(by_threads[0], slow, rtol=tolerance, atol=tolerance)


def test_a_point_without_a_finite_energy_rests() -> None:
    problem, state = structure(KERNELS[1])
    landmarks = state[LANDMARK].copy()
    landmarks[5] = np.nan
    after = settled(problem, state.replace({LANDMARK: landmarks}))
    assert np.isnan(after[LANDMARK][5]).all()
    np.testing.assert_array_equal(
        np.delete(after[LANDMARK], 5, axis=0), np.delete(settled(problem, state)[LANDMARK], 5, 0)
    )


def test_structure_ends_sooner_and_no_higher() -> None:
    problem, state = structure(Kernel("huber", 0.7))
    robust = tuple(
        b if b.factor_type is static_reprojection else replace(b, kernel=Kernel("cauchy", 2.0)) for b in problem.batches
    )
    problem = replace(problem, batches=robust)
    plain = SolverConfig(max_iterations=100, relative_decrease=1e-6)
    ends = [
        minimize(SchurObjective(problem, state, config, LANDMARK), state, config)[1]
        for config in (plain, plain.model_copy(update={"landmark_steps": 12}))
    ]
    assert ends[1].final_energy <= ends[0].final_energy * (1.0 + 1e-6)
    assert len(ends[1].iterations) <= len(ends[0].iterations) // 2
