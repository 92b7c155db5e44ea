"""GTSAM's own factors inside a problem: energies, Jacobians, steps and minima are those of GTSAM."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
import torch
from solve_samples import K, bundle, dense_jacobian, free_mask

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, IMU_BIAS, INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim import cpp_schur
from uni4d_fg.optim.backend import Backend, make_objective
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.optim.gtsam_graph import to_gtsam
from uni4d_fg.optim.gtsam_objective import GtsamObjective
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.native_factors import native_batches
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective

CONFIG = SolverConfig(max_iterations=100, relative_decrease=1e-14, min_diagonal=1e-9)
DAMPING = 1e-3
Factors = list[gtsam.NonlinearFactor]


def sigmas(*values: float) -> gtsam.noiseModel.Diagonal:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array(values))


def robust(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.345), noise)


def near(state: State, frame: int, rng: np.random.Generator) -> gtsam.Pose3:
    return gtsam.Pose3(state[POSE][frame]).retract(rng.normal(scale=0.05, size=6))


def pose_priors(state: State, rng: np.random.Generator) -> Factors:
    noise = sigmas(0.01, 0.02, 0.03, 0.1, 0.2, 0.3)
    return [gtsam.PriorFactorPose3(state.key(POSE, i), near(state, i, rng), noise) for i in (0, 3)]


def odometry(state: State, rng: np.random.Generator) -> Factors:
    noise = sigmas(0.02, 0.02, 0.02, 0.05, 0.05, 0.05)
    return [
        gtsam.BetweenFactorPose3(
            state.key(POSE, i), state.key(POSE, j), near(state, i, rng).between(near(state, j, rng)), noise
        )
        for i, j in ((0, 1), (1, 2), (4, 2))
    ]


def positions(state: State, rng: np.random.Generator) -> Factors:
    noise = sigmas(0.1, 0.1, 0.2)
    return [gtsam.GPSFactor(state.key(POSE, i), rng.normal(scale=0.3, size=3), noise) for i in range(5)]


def robust_odometry(state: State, rng: np.random.Generator) -> Factors:
    noise = robust(sigmas(0.01, 0.01, 0.01, 0.02, 0.02, 0.02))
    wrong = gtsam.Pose3(se3.se3_exp(np.array([[0.2, 0.1, 0.0, 1.0, 0.0, 0.5]]))[0])
    return [
        gtsam.BetweenFactorPose3(state.key(POSE, i), state.key(POSE, j), measured, noise)
        for i, j, measured in ((0, 2, wrong), (1, 3, near(state, 1, rng).between(near(state, 3, rng))))
    ]


def other_variables(state: State, rng: np.random.Generator) -> Factors:
    """A prior on intrinsics, whose tangent in GTSAM has a skew, and on points and scales."""
    return [
        gtsam.PriorFactorCal3_S2(INTRINSICS.key(0), gtsam.Cal3_S2(490.0, 510.0, 0.0, 322.0, 237.0), sigmas(*[8.0] * 5)),
        gtsam.PriorFactorPoint3(state.key(LANDMARK, 2), rng.normal(size=3), sigmas(0.3, 0.4, 0.5)),
        gtsam.PriorFactorVector(state.key(LOG_SCALE, 1), np.array([0.2]), sigmas(0.1)),
        gtsam.PriorFactorVector(state.key(LOG_SCALE, 4), np.array([-0.1]), sigmas(0.2)),
    ]


def users_own(state: State, rng: np.random.Generator) -> Factors:
    """The camera's height above the ground, written as anyone would in GTSAM."""

    def height(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        pose = values.atPose3(this.keys()[0])
        if jacobians is not None:
            jacobians[0] = np.r_[np.zeros(3), pose.rotation().matrix()[2]][None]
        return np.array([pose.z() - 0.3])

    return [gtsam.CustomFactor(sigmas(0.05), [state.key(POSE, i)], height) for i in range(1, 5)]


MAKERS = (pose_priors, odometry, positions, robust_odometry, other_variables, users_own)
every_kind = pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)


def graph_of(factors: Factors) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def everything(rng: np.random.Generator) -> tuple[Problem, State, Factors]:
    """A bundle adjustment, its state and native factors of every kind; the first pose and principal point are held."""
    problem, state = bundle(rng, depth=True)
    factors = [factor for make in MAKERS for factor in make(state, rng)]
    return problem.fix(POSE, rows=[0]).fix(INTRINSICS, entries=[2, 3]), state, factors


@every_kind
def test_energy_is_that_of_the_graph(rng: np.random.Generator, make: Callable[..., Factors]) -> None:
    _, state = bundle(rng, depth=True)
    factors = make(state, rng)
    problem = Problem.over(state).add(factors, state=state)
    assert sum(len(batch) for batch in problem.batches) == len(factors)
    for moved in (state, state.retract({POSE: rng.normal(scale=0.1, size=(5, 6)), LANDMARK: np.ones((24, 3))})):
        expected = graph_of(factors).error(moved.to_values())
        assert expected > 0.1
        np.testing.assert_allclose(problem.energy(moved), expected, rtol=1e-12)
    for native in (True, False):
        graph, values = to_gtsam(problem, state, native=native)
        np.testing.assert_allclose(graph.error(values), problem.energy(state), rtol=1e-9)


def test_like_factors_are_one_batch(rng: np.random.Generator) -> None:
    _, state, factors = everything(rng)
    found = [(b.name, tuple(s.variable for s in b.slots), len(b)) for b in native_batches(factors, state)]
    assert found == [
        ("PriorFactorPose3", (POSE,), 2),
        ("BetweenFactorPose3", (POSE, POSE), 5),
        ("GPSFactor", (POSE,), 5),
        ("PriorFactorCal3_S2", (INTRINSICS,), 1),
        ("PriorFactorPoint3", (LANDMARK,), 1),
        ("PriorFactorVector", (LOG_SCALE,), 2),
        ("CustomFactor", (POSE,), 4),
    ]
    assert native_batches([], state) == []


def gtsam_system(factors: Factors, state: State, groups: list) -> tuple[np.ndarray, np.ndarray]:
    """Return Hessian and gradient of native factors by GTSAM, on every entry of the groups."""
    values, gaussian = state.to_values(), graph_of(factors).linearize(state.to_values())
    ordering, columns, start = gtsam.Ordering(), [], 0
    read = set(graph_of(factors).keyVector())
    offset, size = {}, 0
    for variable in groups:
        for key in state.keys(variable):
            offset[key] = size
            size += variable.dim
    places = []
    for key in (k for k in offset if k in read):
        variable = next(v for v in groups if key in state.keys(v))
        ordering.push_back(key)
        width = len(values.zeroVectors().at(key))
        columns += [start + c for c in variable.gtsam_columns or range(variable.dim)]
        places += [offset[key] + c for c in range(variable.dim)]
        start += width
    small, minus_gradient = gaussian.hessian(ordering)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    hessian[np.ix_(places, places)] = small[np.ix_(columns, columns)]
    gradient[places] = -minus_gradient[columns]
    return hessian, gradient


def test_the_step_is_that_of_dense_gauss_newton(rng: np.random.Generator) -> None:
    problem, state, factors = everything(rng)
    groups = [POSE, INTRINSICS, LOG_SCALE, LANDMARK]
    jacobian, r, _ = dense_jacobian(problem, state, groups)
    of_gtsam = gtsam_system(factors, state, groups)
    free = np.flatnonzero(free_mask(problem, state, groups))
    hessian = (jacobian.T @ jacobian + of_gtsam[0])[np.ix_(free, free)]
    gradient = (jacobian.T @ r + of_gtsam[1])[free]
    damped = hessian + DAMPING * np.diag(np.clip(np.diag(hessian), CONFIG.min_diagonal, CONFIG.max_diagonal))
    expected = np.zeros(jacobian.shape[1])
    expected[free] = np.linalg.solve(damped, -gradient)

    without = SchurObjective(problem, state, CONFIG).linearize(state).solve(DAMPING)
    problem.add(factors, state=state)
    linearization = SchurObjective(problem, state, CONFIG).linearize(state)
    step = linearization.solve(DAMPING)
    assert step is not None
    assert without is not None
    pull = max(np.abs(step.delta[variable] - without.delta[variable]).max() for variable in (POSE, LANDMARK))
    assert pull > 0.01, "the native factors count"
    ours = np.concatenate([step.delta[variable].reshape(-1) for variable in groups])
    np.testing.assert_allclose(ours, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(linearization.gradient_max, np.abs(gradient).max(), rtol=1e-9)


def test_the_minimum_is_gtsams_for_every_solver(rng: np.random.Generator) -> None:
    problem, state, factors = everything(rng)
    problem.add(factors, state=state).eliminate(LANDMARK)
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(300)
    params.setRelativeErrorTol(1e-15)
    params.setAbsoluteErrorTol(1e-15)
    graph, values = to_gtsam(problem, state)
    expected = state.with_values(gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize())
    assert cpp_schur.refusal(problem) == ""
    # GTSAM holds frozen entries by tight priors, against which the factors on them pull a little.
    poses, intrinsics = expected[POSE].copy(), expected[INTRINSICS].copy()
    poses[0], intrinsics[0, 2:] = state[POSE][0], state[INTRINSICS][0, 2:]
    expected = expected.replace({POSE: poses, INTRINSICS: intrinsics})
    solvers = [("python", SchurObjective), ("gtsam", GtsamObjective)]
    if find_extension()[0] is not None:
        solvers.append(("cpp", cpp_schur.CppSchurObjective))
    for backend, by in solvers:
        planned = make_objective(Backend(backend), problem, state, CONFIG)
        assert type(planned.objective) is by
        assert planned.why == ""
        assert {term for part in planned.parts() for term in part.terms} == {batch.name for batch in problem.batches}
        found, summary = minimize(planned.objective, state, CONFIG)
        assert summary.converged
        assert summary.initial_energy > 5.0 * summary.final_energy
        np.testing.assert_allclose(summary.final_energy, problem.energy(expected), rtol=1e-8)
        np.testing.assert_allclose(found[POSE], expected[POSE], atol=1e-5)
        np.testing.assert_array_equal(found[POSE][0], state[POSE][0])


def test_a_factor_whose_key_the_problem_lacks_is_named(rng: np.random.Generator) -> None:
    _, state = bundle(rng)
    noise = sigmas(*[0.1] * 6)
    for factor, message in (
        (
            gtsam.BetweenFactorPose3(POSE.key(1), POSE.key(9), gtsam.Pose3(np.eye(4)), noise),
            "BetweenFactorPose3 reads camera pose, frame 9, which the problem does not have",
        ),
        (
            gtsam.PriorFactorPoint3(LANDMARK.key(11), np.zeros(3), sigmas(1.0, 1.0, 1.0)),
            "PriorFactorPoint3 reads landmark, track 11, which the problem does not have",
        ),
        (
            gtsam.PriorFactorPoint3(DYNAMIC_POINT.key(17, 3), np.zeros(3), sigmas(1.0, 1.0, 1.0)),
            "PriorFactorPoint3 reads dynamic point, track 17, frame 3, which the problem does not have",
        ),
        (
            gtsam.PriorFactorPose3(gtsam.symbol("j", 0), gtsam.Pose3(np.eye(4)), noise),
            f"PriorFactorPose3 reads unknown variable {gtsam.symbol('j', 0)}, which the problem does not have",
        ),
        (
            gtsam.PriorFactorConstantBias(IMU_BIAS.key(0), gtsam.imuBias.ConstantBias(), noise),
            "PriorFactorConstantBias reads IMU bias, frame 0, which the problem does not have",
        ),
    ):
        with pytest.raises(SolverError, match=message):
            Problem.over(state).add(factor, state=state)


def test_a_native_factor_that_is_not_finite_is_named(rng: np.random.Generator) -> None:
    _, state = bundle(rng)
    landmark = state.key(LANDMARK, 4)
    broken = gtsam.PriorFactorPoint3(landmark, np.full(3, np.nan), sigmas(1.0, 1.0, 1.0))
    problem = Problem.over(state).add(broken, state=state)
    with pytest.raises(SolverError, match=r"PriorFactorPoint3: a factor is not finite .* landmark, track 22"):
        SchurObjective(problem, state, CONFIG).linearize(state)


def test_adam_cannot_differentiate_them(rng: np.random.Generator) -> None:
    _, state = bundle(rng)
    (batch,) = native_batches(pose_priors(state, rng), state)
    with pytest.raises(SolverError, match="PriorFactorPose3 is a factor of GTSAM's, which Adam cannot differentiate"):
        batch.factor_type.residual(torch.from_numpy(state[POSE][[0, 3]]), number=torch.arange(2))


def test_a_calibration_keeps_its_skew_out(rng: np.random.Generator) -> None:
    """GTSAM's tangent of a pinhole has five entries, ours the four without the skew."""
    state = State({INTRINSICS: K[None] + 3.0})
    prior = gtsam.PriorFactorCal3_S2(INTRINSICS.key(0), gtsam.Cal3_S2(*K[:2], 0.0, *K[2:]), sigmas(1, 2, 4, 5, 6))
    (batch,) = native_batches([prior], state)
    r, (jacobian,) = batch.linearize(state)
    assert jacobian.shape == (1, 5, 4)
    np.testing.assert_allclose(r[0], 3.0 / np.array([1, 2, np.inf, 5, 6]), atol=1e-12)
    np.testing.assert_allclose(jacobian[0].T @ jacobian[0], np.diag(1.0 / np.array([1, 2, 5, 6]) ** 2), atol=1e-12)
    np.testing.assert_allclose(batch.energy(state), 4.5 * np.sum(1.0 / np.array([1, 2, 5, 6]) ** 2), rtol=1e-12)
