"""Marginalization: nothing is lost of a linear problem; the linear prior's Jacobians; what carries nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solve_samples import LANDMARK_PRIOR, bundle

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.marginalization_prior import marginalization_prior_type
from uni4d_fg.factors.priors import log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import inverse_right_jacobian, se3_log
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.marginalization import marginalize
from uni4d_fg.optim.marginals import camera_marginals, reduced_hessian
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.schur import SchurObjective

CONFIG = SolverConfig(max_iterations=50, relative_decrease=1e-12, min_diagonal=1e-12, initial_damping=1e-14)
WEIGHTS = np.array([[1.0, 0.3, -0.2], [0.1, 1.0, 0.4]])


def _residual(log_scale, landmark, *, measured):
    return landmark @ WEIGHTS.T - log_scale - measured


def _linearize(log_scale, landmark, *, measured):
    n = len(log_scale)
    jacobians = [-np.ones((n, 2, 1)), np.broadcast_to(WEIGHTS, (n, 2, 3))]
    return _residual(log_scale, landmark, measured=measured), jacobians


LINEAR = FactorType("linear", (LOG_SCALE, LANDMARK), {"measured": (2,)}, 2, _residual, _linearize, listed=False)


def _step_residual(first, second, *, measured):
    return second - first - measured


def _step_linearize(first, second, *, measured):
    one = np.ones((len(first), 1, 1))
    return _step_residual(first, second, measured=measured), [-one, one]


STEP = FactorType("step", (LOG_SCALE, LOG_SCALE), {"measured": (1,)}, 1, _step_residual, _step_linearize, listed=False)


def linear_chain(rng: np.random.Generator, length: int, span: int) -> tuple[list[FactorBatch], State, np.ndarray]:
    """A chain of scalars with landmarks, each seen by ``span`` successive scalars; first scalar of each landmark."""
    first = np.repeat(np.arange(length - span + 1), 3)
    landmark = np.repeat(np.arange(len(first)), span)
    scalar = (first[:, None] + np.arange(span)).reshape(-1)
    batches = [
        FactorBatch.create(
            LINEAR, (Slot(LOG_SCALE, scalar), Slot(LANDMARK, landmark)),
            {"measured": rng.normal(size=(len(scalar), 2))}, sigma=0.3,
        ),
        FactorBatch.create(
            LANDMARK_PRIOR, (Slot(LANDMARK, np.arange(len(first))),),
            {"measured": rng.normal(size=(len(first), 3))}, sigma=2.0,
        ),
        FactorBatch.create(
            STEP, (Slot(LOG_SCALE, np.arange(length - 1)), Slot(LOG_SCALE, np.arange(1, length))),
            {"measured": rng.normal(size=(length - 1, 1))}, sigma=0.5,
        ),
        FactorBatch.create(
            log_scale_prior, (Slot(LOG_SCALE, np.arange(length)),), {"measured": np.zeros((length, 1))}, sigma=1.0
        ),
    ]  # fmt: skip
    state = State({LOG_SCALE: np.zeros((length, 1)), LANDMARK: np.zeros((len(first), 3))})
    return batches, state, first


def reads(batch: FactorBatch, group: VariableType, rows: np.ndarray) -> np.ndarray:
    return np.logical_or.reduce([np.isin(s.rows, rows) for s in batch.slots if s.variable == group] or [False])


@pytest.mark.parametrize("span", [2, 4])
def test_a_sliding_window_equals_the_whole_linear_problem(rng: np.random.Generator, span: int) -> None:
    length, window = 15, 5
    batches, state, first = linear_chain(rng, length, span)
    whole = Problem(tuple(batches), all_free(state, LOG_SCALE, LANDMARK))
    expected, _ = minimize(SchurObjective(whole, state, CONFIG), state, CONFIG)
    reference = camera_marginals(whole, expected, CONFIG)
    assert reference is not None
    left = list(batches)
    for oldest in range(length - window):
        gone = np.flatnonzero(first <= oldest)
        used, kept = [], []
        for batch in left:
            touched = np.broadcast_to(
                reads(batch, LOG_SCALE, np.array([oldest])) | reads(batch, LANDMARK, gone), len(batch)
            )
            used.append(batch.take(np.flatnonzero(touched)))
            kept.append(batch.take(np.flatnonzero(~touched)))
        # Another linearization point each time: a linear problem does not mind.
        here = state.replace({LOG_SCALE: rng.normal(size=(length, 1)), LANDMARK: rng.normal(size=(len(first), 3))})
        leaving = {LOG_SCALE: np.arange(length) == oldest}
        prior = marginalize(tuple(used), here, all_free(state, LOG_SCALE), leaving, CONFIG)
        assert prior is not None
        left = [*kept, prior]
    rest = Problem(tuple(b for b in left if len(b)), all_free(state, LOG_SCALE, LANDMARK))
    found, _ = minimize(SchurObjective(rest, state, CONFIG), state, CONFIG)
    last = np.arange(length - window, length)
    np.testing.assert_allclose(found[LOG_SCALE][last], expected[LOG_SCALE][last], atol=1e-9)
    alive = first >= length - window
    np.testing.assert_allclose(found[LANDMARK][alive], expected[LANDMARK][alive], atol=1e-9)
    free = {
        LOG_SCALE: np.isin(np.arange(length), last)[:, None],
        LANDMARK: np.tile(alive[:, None], (1, 3)),
    }
    marginals = camera_marginals(Problem(rest.batches, free), found, CONFIG)
    assert marginals is not None
    np.testing.assert_allclose(marginals.covariance[-window:, -window:], reference.covariance[-window:, -window:])


def test_the_logarithm_and_its_jacobian(rng: np.random.Generator) -> None:
    twist = rng.normal(scale=0.3, size=(20, 6))
    np.testing.assert_allclose(se3_log(se3.se3_exp(twist)), twist, atol=1e-12)
    np.testing.assert_allclose(se3_log(se3.se3_exp(1e-6 * twist)), 1e-6 * twist, atol=1e-15)
    jacobian, step = inverse_right_jacobian(twist), 1e-6
    for i in range(6):
        d = step * np.eye(6)[i]
        moved = se3_log(se3.retract(se3.se3_exp(twist), np.tile(d, (20, 1))))
        back = se3_log(se3.retract(se3.se3_exp(twist), np.tile(-d, (20, 1))))
        np.testing.assert_allclose(jacobian[:, :, i], (moved - back) / (2 * step), atol=1e-7)


def test_the_prior_is_the_reduced_system_at_its_point(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, depth=True)
    free = {g: m for g, m in problem.free.items() if g != LANDMARK}
    leaving = {POSE: np.arange(5) < 2, LOG_SCALE: np.arange(5) < 2}
    prior = marginalize(problem.batches, state, free, leaving, CONFIG)
    assert prior is not None
    reduced = reduced_hessian(problem, state, CONFIG)
    assert reduced is not None
    layout, hessian, gradient = reduced
    rows = {POSE: np.arange(2), LOG_SCALE: np.arange(2)}
    out = np.concatenate([layout.columns(g, r).reshape(-1) for g, r in rows.items()])
    stay = np.setdiff1d(np.arange(layout.size), out)
    inverse = np.linalg.inv(hessian[np.ix_(out, out)])
    information = hessian[np.ix_(stay, stay)] - hessian[np.ix_(stay, out)] @ inverse @ hessian[np.ix_(out, stay)]
    slope = gradient[stay] - hessian[np.ix_(stay, out)] @ inverse @ gradient[out]
    r, jacobians = prior.linearize(state)
    blocks = np.zeros((len(r[0]), layout.size))
    for slot, jacobian in zip(prior.slots, jacobians, strict=True):
        blocks[:, layout.columns(slot.variable, slot.rows)[0]] = jacobian[0]
    blocks = blocks[:, stay]
    np.testing.assert_allclose(blocks.T @ blocks, information, rtol=1e-6, atol=1e-9 * np.abs(information).max())
    np.testing.assert_allclose(blocks.T @ r[0], slope, rtol=1e-5, atol=1e-7 * np.abs(slope).max())


def test_the_prior_differentiates_as_it_says(rng: np.random.Generator) -> None:
    prior = marginalization_prior_type((POSE, INTRINSICS, LOG_SCALE))
    point = se3.se3_exp(rng.normal(scale=0.3, size=(1, 6)))
    data = {
        "root": rng.normal(size=(1, 11, 11)), "offset": rng.normal(size=(1, 11)), "point_0": point,
        "point_1": rng.normal(size=(1, 4)), "point_2": rng.normal(size=(1, 1)),
    }  # fmt: skip
    values = [se3.retract(point, rng.normal(scale=0.05, size=(1, 6))), rng.normal(size=(1, 4)), np.zeros((1, 1))]
    _, jacobians = prior.linearize(*values, **data)
    for slot, (value, jacobian) in enumerate(zip(values, jacobians, strict=True)):
        for i in range(jacobian.shape[2]):
            d = 1e-6 * np.eye(jacobian.shape[2])[[i]]
            ends = [se3.retract(value, s * d) if slot == 0 else value + s * d for s in (1.0, -1.0)]
            numeric = [prior.residual(*values[:slot], end, *values[slot + 1 :], **data) for end in ends]
            np.testing.assert_allclose(jacobian[0, :, i], (numeric[0] - numeric[1])[0] / 2e-6, atol=1e-6)


def test_a_landmark_that_is_not_determined_carries_nothing(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    reprojection = problem.batches[0]
    rows = next(s.rows for s in reprojection.slots if s.variable == LANDMARK)
    once = reprojection.take(np.flatnonzero(rows == 3)[:1])
    free = {g: m for g, m in problem.free.items() if g != LANDMARK}
    assert marginalize((once,), state, free, {POSE: np.arange(5) == 0}, CONFIG) is None
    others = reprojection.take(np.flatnonzero(rows != 3))
    with_it = marginalize((once, others, *problem.batches[2:]), state, free, {POSE: np.arange(5) == 0}, CONFIG)
    without = marginalize((others, *problem.batches[2:]), state, free, {POSE: np.arange(5) == 0}, CONFIG)
    assert with_it is not None
    assert without is not None
    for name in ("root", "offset"):
        squares = [np.swapaxes(p.data["root"], 1, 2) @ p.data[name].reshape(1, len(p.data["root"][0]), -1)
                   for p in (with_it, without)]  # fmt: skip
        np.testing.assert_allclose(squares[0], squares[1], rtol=1e-6, atol=1e-6 * np.abs(squares[1]).max())


def test_frozen_entries_stay_constants(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    free = {g: m.copy() for g, m in problem.free.items() if g != LANDMARK}
    free[INTRINSICS][0, 2:] = False
    prior = marginalize(problem.batches, state, free, {POSE: np.arange(5) == 0}, CONFIG)
    assert prior is not None
    _, jacobians = prior.linearize(state)
    at = next(i for i, s in enumerate(prior.slots) if s.variable == INTRINSICS)
    assert (jacobians[at][0, :, 2:] == 0.0).all()
    assert np.abs(jacobians[at][0, :, :2]).max() > 0.0
    solved, _ = minimize(SchurObjective(Problem((prior,), free), state, CONFIG, None), state, CONFIG)
    np.testing.assert_array_equal(solved[INTRINSICS][0, 2:], state[INTRINSICS][0, 2:])
    assert replace(prior, term="x").name == "x"
