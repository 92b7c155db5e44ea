"""The factor graph of a problem carries the problem's energy."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.kernels import Kernel, KernelKind
from uni4d_fg.factors.priors import INTRINSICS_PRIOR, LOG_SCALE_PRIOR
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.factors.temporal_smoothness import VELOCITY_SMOOTHNESS
from uni4d_fg.geometry import se3
from uni4d_fg.graph.problem import Problem, all_free
from uni4d_fg.graph.state import State
from uni4d_fg.solve.gtsam_objective import GtsamObjective


def make_problem(kind: KernelKind) -> tuple[Problem, State]:
    rng = np.random.default_rng(0)
    state = State(
        {
            "pose": se3.se3_exp(0.05 * rng.normal(size=(3, 6))),
            "landmark": rng.normal(size=(9, 3)) + np.array([0.0, 0.0, 5.0]),
            "intrinsics": np.array([[300.0, 310.0, 160.0, 120.0]]),
            "log_scale": 0.1 * rng.normal(size=(3, 1)),
            "dynamic_point": rng.normal(size=(6, 3)),
        }
    )
    pose, landmark = np.repeat(np.arange(3), 9), np.tile(np.arange(9), 3)
    one, kernel = np.zeros(27, dtype=np.int64), Kernel(kind, 1.3)
    batches = (
        FactorBatch.create(
            STATIC_REPROJECTION,
            (Slot("pose", pose), Slot("landmark", landmark), Slot("intrinsics", one)),
            {"uv": rng.uniform(0, 300, (27, 2))},
            sigma=rng.uniform(1, 90, 27),
            weight=rng.uniform(0, 2, 27) * (rng.random(27) > 0.2),
            kernel=kernel,
        ),
        FactorBatch.create(
            VELOCITY_SMOOTHNESS,
            (Slot("dynamic_point", np.arange(5)), Slot("dynamic_point", np.arange(1, 6))),
            sigma=rng.uniform(0.1, 2, (5, 3)),
            weight=0.7,
            kernel=kernel,
        ),
        FactorBatch.create(
            LOG_SCALE_PRIOR, (Slot("log_scale", np.arange(3)),), {"measured": np.zeros((3, 1))}, sigma=0.1
        ),
        FactorBatch.create(
            INTRINSICS_PRIOR,
            (Slot("intrinsics", one[:1]),),
            {"measured": state["intrinsics"] + 20.0},
            sigma=np.array([[30.0, 31.0, 30.0, 31.0]]),
        ),
    )
    free = all_free(state, "pose", "landmark", "log_scale", "dynamic_point")
    free["pose"][0] = False
    free["intrinsics"] = np.array([[True, True, False, False]])
    return Problem(batches, free), state


@pytest.mark.parametrize("kind", ["quadratic", "huber", "pseudo_huber", "cauchy", "norm"])
def test_energy_and_gradient_of_the_graph(kind: KernelKind) -> None:
    problem, state = make_problem(kind)
    objective = GtsamObjective(problem, state)
    expected = problem.energies(state)
    assert objective.energies(state) == pytest.approx(expected, rel=1e-9)
    largest = objective.linearize(state).gradient_max
    gradient = {group: np.zeros_like(mask, dtype=float) for group, mask in problem.free.items()}
    for batch in problem.batches:
        r, jacobians = batch.linearize(state)
        for slot, jacobian in zip(batch.slots, jacobians, strict=True):
            np.add.at(gradient[slot.group], slot.rows, np.einsum("nd,ndk->nk", r, jacobian))
    ours = max(np.abs(g[problem.free[group]]).max() for group, g in gradient.items())
    held = np.abs(gradient["intrinsics"][0, 2:]).max()
    assert largest == pytest.approx(max(ours, held), rel=1e-6)


def test_frozen_entries_stay_exactly_where_they_are() -> None:
    problem, state = make_problem("huber")
    objective = GtsamObjective(problem, state)
    step = objective.linearize(state).solve(1.0)
    assert step is not None
    moved = objective.retract(state, step.delta)
    np.testing.assert_array_equal(moved["pose"][0], state["pose"][0])
    np.testing.assert_array_equal(moved["intrinsics"][0, 2:], state["intrinsics"][0, 2:])
    assert np.abs(moved["intrinsics"][0, :2] - state["intrinsics"][0, :2]).max() > 1e-6
    assert sum(objective.energies(moved).values()) < sum(objective.energies(state).values())
