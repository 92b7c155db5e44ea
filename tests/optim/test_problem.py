"""Problem: putting it together from factors of any kind, what is free, and its energy."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from solve_samples import K, bundle

from uni4d_fg.errors import SolverError
from uni4d_fg.factors import Kernel
from uni4d_fg.factors.priors import intrinsics_prior, log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.solve import marginals, solve


@pytest.fixture
def state(rng: np.random.Generator) -> State:
    return State(
        {
            POSE: se3.se3_exp(rng.normal(scale=0.4, size=(4, 6))),
            INTRINSICS: K[None].copy(),
            LOG_SCALE: rng.normal(size=(4, 1)),
            LANDMARK: rng.normal(size=(5, 3)),
        }
    )


def test_problem_reports_what_is_free(state: State) -> None:
    free = all_free(state, POSE, LANDMARK)
    free[POSE][0] = False
    free[INTRINSICS] = np.zeros((1, 4), dtype=bool)
    problem = Problem((), free)
    assert problem.is_free(POSE)
    assert not problem.is_free(INTRINSICS)
    assert not problem.is_free(LOG_SCALE)
    rows = problem.free_rows()
    assert set(rows) == {POSE, LANDMARK}
    np.testing.assert_array_equal(rows[POSE], [False, True, True, True])


def test_everything_is_free_until_it_is_fixed(state: State) -> None:
    problem = Problem.over(state)
    assert {variable: mask.shape for variable, mask in problem.free.items()} == {
        POSE: (4, 6), INTRINSICS: (1, 4), LOG_SCALE: (4, 1), LANDMARK: (5, 3),
    }  # fmt: skip
    assert all(mask.all() for mask in problem.free.values())
    before = problem.free[POSE]
    assert problem.fix(POSE, rows=[0]).fix(POSE, rows=[2, 3], entries=[0, 1, 2]).fix(LOG_SCALE) is problem
    problem.fix(INTRINSICS, entries=[2, 3]).fix(DYNAMIC_POINT).eliminate(LANDMARK)
    assert before.all(), "masks that others hold are left alone"
    expected = np.ones((4, 6), dtype=bool)
    expected[0] = expected[2:, :3] = False
    np.testing.assert_array_equal(problem.free[POSE], expected)
    np.testing.assert_array_equal(problem.free[INTRINSICS], [[True, True, False, False]])
    assert not problem.is_free(LOG_SCALE)
    assert DYNAMIC_POINT not in problem.free
    assert problem.free[LANDMARK].all()
    assert problem.eliminated is LANDMARK
    assert problem.eliminate(None).eliminated is None


def test_factors_of_any_kind_and_nesting_are_added(state: State) -> None:
    scale = log_scale_prior(np.arange(4), measured=np.zeros((4, 1)), sigma=0.1)
    prior = intrinsics_prior([0], measured=K[None] + 1.0, sigma=0.5)
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph = gtsam.NonlinearFactorGraph()
    for frame in range(3):
        odometry = gtsam.Pose3(np.eye(4))
        graph.push_back(gtsam.BetweenFactorPose3(POSE.key(frame), POSE.key(frame + 1), odometry, noise))
    first = gtsam.PriorFactorPose3(POSE.key(0), gtsam.Pose3(np.eye(4)), noise)
    problem = Problem.over(state).add(scale).add([prior, (graph, first)], state=state)
    assert [batch.name for batch in problem.batches] == [
        "log_scale_prior", "intrinsics_prior", "BetweenFactorPose3", "PriorFactorPose3",
    ]  # fmt: skip
    assert [len(batch) for batch in problem.batches] == [4, 1, 3, 1]
    energies = problem.energies(state)
    assert energies["log_scale_prior"] == pytest.approx(0.5 * np.sum(state[LOG_SCALE] ** 2) / 0.01)
    assert energies["intrinsics_prior"] == pytest.approx(0.5 * 4 / 0.25)
    assert energies["BetweenFactorPose3"] == pytest.approx(graph.error(state.to_values()), rel=1e-12)
    assert energies["PriorFactorPose3"] == pytest.approx(first.error(state.to_values()), rel=1e-12)
    assert problem.energy(state) == pytest.approx(sum(energies.values()), rel=1e-15)
    with pytest.raises(SolverError, match=r"needs the state whose keys it reads: problem\.add\(f, state=state\)"):
        Problem.over(state).add(first)


def test_terms_of_one_name_add_up_and_exact_leaves_out_the_smoothing(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, kernel=Kernel("norm", 0.5))
    batch = problem.batches[0]
    problem.add(replace(batch, kernel=Kernel()))
    squared = batch.squared_norm(state)
    assert set(problem.energies(state)) == {"static_reprojection", "landmark_prior", "intrinsics_prior"}
    smooth, exact = (problem.energies(state, exact=e)["static_reprojection"] for e in (False, True))
    assert smooth == pytest.approx(np.sum(np.sqrt(squared + 0.25) - 0.5) + 0.5 * np.sum(squared), rel=1e-12)
    assert exact == pytest.approx(np.sum(np.sqrt(squared)) + 0.5 * np.sum(squared), rel=1e-12)
    others = problem.energy(state) - smooth
    assert problem.energy(state, exact=True) - exact == pytest.approx(others, rel=1e-9)


def test_rows_that_the_state_does_not_have_are_named(state: State) -> None:
    far = log_scale_prior(np.arange(6), measured=np.zeros((6, 1)), sigma=0.1)
    said = r"log_scale_prior reads row 4 of log_scale \(depth log-scale, frame 4\), which the problem does not have"
    problem = Problem.over(state).add(far)
    with pytest.raises(SolverError, match=said):
        solve(problem, state)
    with pytest.raises(SolverError, match=said):
        marginals(problem, state, LOG_SCALE)
    with pytest.raises(SolverError, match=said):
        Problem.over(state).add(far, state=state)
