"""The factor graph of a problem carries the problem's energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.kernels import Kernel, KernelKind
from uni4d_fg.factors.priors import intrinsics_prior, log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.temporal_smoothness import velocity_smoothness
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim.gtsam_objective import GtsamObjective
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.schur import SchurObjective


def make_problem(kind: KernelKind) -> tuple[Problem, State]:
    rng = np.random.default_rng(0)
    state = State(
        {
            POSE: se3.se3_exp(0.05 * rng.normal(size=(3, 6))),
            LANDMARK: rng.normal(size=(9, 3)) + np.array([0.0, 0.0, 5.0]),
            INTRINSICS: np.array([[300.0, 310.0, 160.0, 120.0]]),
            LOG_SCALE: 0.1 * rng.normal(size=(3, 1)),
            DYNAMIC_POINT: rng.normal(size=(6, 3)),
        }
    )
    pose, landmark = np.repeat(np.arange(3), 9), np.tile(np.arange(9), 3)
    one, kernel = np.zeros(27, dtype=np.int64), Kernel(kind, 1.3)
    batches = (
        FactorBatch.create(
            static_reprojection,
            (Slot(POSE, pose), Slot(LANDMARK, landmark), Slot(INTRINSICS, one)),
            {"uv": rng.uniform(0, 300, (27, 2))},
            sigma=rng.uniform(1, 90, 27),
            weight=rng.uniform(0, 2, 27) * (rng.random(27) > 0.2),
            kernel=kernel,
        ),
        FactorBatch.create(
            velocity_smoothness,
            (Slot(DYNAMIC_POINT, np.arange(5)), Slot(DYNAMIC_POINT, np.arange(1, 6))),
            sigma=rng.uniform(0.1, 2, (5, 3)),
            weight=0.7,
            kernel=kernel,
        ),
        FactorBatch.create(
            log_scale_prior, (Slot(LOG_SCALE, np.arange(3)),), {"measured": np.zeros((3, 1))}, sigma=0.1
        ),
        FactorBatch.create(
            intrinsics_prior,
            (Slot(INTRINSICS, one[:1]),),
            {"measured": state[INTRINSICS] + 20.0},
            sigma=np.array([[30.0, 31.0, 30.0, 31.0]]),
        ),
    )
    free = all_free(state, POSE, LANDMARK, LOG_SCALE, DYNAMIC_POINT)
    free[POSE][0] = False
    free[INTRINSICS] = np.array([[True, True, False, False]])
    return Problem(batches, free), state


@pytest.mark.parametrize("kind", ["quadratic", "huber", "pseudo_huber", "cauchy", "norm"])
def test_energy_and_gradient_of_the_graph(kind: KernelKind) -> None:
    problem, state = make_problem(kind)
    objective = GtsamObjective(problem, state, SolverConfig())
    expected = problem.energies(state)
    assert objective.energies(state) == pytest.approx(expected, rel=1e-9)
    largest = objective.linearize(state).gradient_max
    gradient = {group: np.zeros_like(mask, dtype=float) for group, mask in problem.free.items()}
    for batch in problem.batches:
        r, jacobians = batch.linearize(state)
        for slot, jacobian in zip(batch.slots, jacobians, strict=True):
            np.add.at(gradient[slot.variable], slot.rows, np.einsum("nd,ndk->nk", r, jacobian))
    ours = max(np.abs(g[problem.free[group]]).max() for group, g in gradient.items())
    assert largest == pytest.approx(ours, rel=1e-6)
    # What is frozen does not count.
    focal = replace(problem, free={INTRINSICS: np.array([[True, False, False, False]])})
    smaller = GtsamObjective(focal, state, SolverConfig()).linearize(state).gradient_max
    assert smaller == pytest.approx(abs(gradient[INTRINSICS][0, 0]), rel=1e-6)
    assert smaller < 0.5 * ours


def test_frozen_entries_stay_exactly_where_they_are() -> None:
    problem, state = make_problem("huber")
    objective = GtsamObjective(problem, state, SolverConfig())
    step = objective.linearize(state).solve(1.0)
    assert step is not None
    moved = objective.retract(state, step.delta)
    np.testing.assert_array_equal(moved[POSE][0], state[POSE][0])
    np.testing.assert_array_equal(moved[INTRINSICS][0, 2:], state[INTRINSICS][0, 2:])
    assert np.abs(moved[INTRINSICS][0, :2] - state[INTRINSICS][0, :2]).max() > 1e-6
    assert sum(objective.energies(moved).values()) < sum(objective.energies(state).values())


def test_the_step_is_the_one_without_frozen_entries() -> None:
    """The priors that hold them give way a little, which is neither step nor decrease."""
    problem, state = make_problem("quadratic")
    problem = replace(problem, batches=tuple(b.take(np.flatnonzero(b.weight > 0)) for b in problem.batches))
    step = GtsamObjective(problem, state, SolverConfig()).linearize(state).solve(1e-3)
    reference = SchurObjective(problem, state, SolverConfig(), LANDMARK).linearize(state).solve(1e-3)
    assert step is not None
    assert reference is not None
    assert step.norm == pytest.approx(reference.norm, rel=1e-6)
    assert step.predicted_decrease == pytest.approx(reference.predicted_decrease, rel=1e-8)
    np.testing.assert_array_equal(step.delta.at(POSE.key(0)), 0.0)
    np.testing.assert_array_equal(step.delta.at(INTRINSICS.key(0))[2:], 0.0)
    np.testing.assert_allclose(step.delta.at(INTRINSICS.key(0))[:2], reference.delta[INTRINSICS][0, :2], rtol=1e-6)
