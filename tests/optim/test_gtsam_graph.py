"""A problem as GTSAM's graph: energy, Jacobians, Hessian, stacking, what is held, the minimum of GTSAM's own solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.utils.numerical_derivative import numericalDerivative11
from solve_samples import POINT_PRIOR, bundle, camera_path, pair_terms, slot, trajectories

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorBatch, Kernel, VariableType
from uni4d_fg.factors.camera_motion import camera_rotation, camera_translation
from uni4d_fg.factors.priors import aspect_prior, intrinsics_prior, log_scale_prior, scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.temporal_smoothness import velocity_smoothness
from uni4d_fg.factors.variable import format_key, locate
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.optim.gaussian_graph import GraphObjective
from uni4d_fg.optim.gtsam_graph import HELD_SIGMA, gtsam_factors, to_gtsam
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.schur import SchurObjective

KERNELS = [Kernel(), Kernel("huber", 1.0), Kernel("pseudo_huber", 1.0), Kernel("cauchy", 2.0), Kernel("norm", 0.1)]
TIGHT = SolverConfig(max_iterations=300, relative_decrease=1e-14)
K = np.array([500.0, 505.0, 320.0, 240.0])
HOW = [(True, True), (True, False), (False, True), (False, False)]
HOW_IDS = ["native, stacked", "native, one by one", "custom, stacked", "custom, one by one"]
Made = tuple[Problem, State]
Make = Callable[[np.random.Generator, Kernel], Made]


def first_batch(problem: Problem, batch: FactorBatch) -> Problem:
    return replace(problem, batches=(batch, *problem.batches[1:]))


def static_scene(rng: np.random.Generator, kernel: Kernel) -> Made:
    """Bundle adjustment with depth, camera motion, weights of zero, one held pose and a held principal point."""
    problem, state = bundle(rng, kernel=kernel, outliers=6, depth=True)
    weight = rng.uniform(0.0, 2.0, len(problem.batches[0])) * (rng.random(len(problem.batches[0])) > 0.1)
    problem = first_batch(problem, replace(problem.batches[0], weight=weight))
    middle = np.arange(1, 4)
    problem.add(
        camera_rotation(middle - 1, middle, middle + 1, floor=np.full(3, 1e-3), sigma=0.5, kernel=kernel),
        camera_translation(middle - 1, middle, middle + 1, floor=np.full(3, 1e-3), sigma=0.5, kernel=kernel),
        intrinsics_prior([0], measured=K[None] * 1.01, sigma=np.array([[5.0, 6.0, 7.0, 8.0]]), kernel=kernel),
        log_scale_prior(np.arange(5), measured=np.full((5, 1), 0.1), sigma=0.05, kernel=kernel),
    )
    return problem.fix(POSE, rows=[0]).fix(INTRINSICS, entries=[2, 3]).fix(LANDMARK, rows=[2, 7]), state


def frame_pairs(rng: np.random.Generator, kernel: Kernel) -> Made:
    """Camera initialization: pairs of frames, one focal length and the aspect ratio held by priors."""
    count = 6
    state = State(
        {
            POSE: se3.retract(camera_path(count), rng.normal(scale=0.01, size=(count, 6))),
            INTRINSICS: K[None] * 1.01,
        },
        {POSE: 3 * np.arange(count)},
    )
    problem = Problem.over(state).add(
        replace(pair_terms(rng, count, 60, same=False), kernel=kernel),
        intrinsics_prior([0], measured=K[None], sigma=5.0),
        aspect_prior([0], measured=np.log(K[:1] / K[1]), sigma=0.01),
        scale_anchor([0], [5], distance=np.array([0.8]), sigma=0.01),
    )
    return problem.fix(POSE, rows=[0]).fix(INTRINSICS, entries=[2, 3]), state


def moving_points(rng: np.random.Generator, kernel: Kernel) -> Made:
    problem, state = trajectories(rng, kernel=kernel)
    row = np.arange(len(state[DYNAMIC_POINT])).reshape(6, 7)
    smooth = velocity_smoothness(row[:, :-1].reshape(-1), row[:, 1:].reshape(-1), sigma=0.1, weight=0.4, kernel=kernel)
    return problem.add(smooth), state


PROBLEMS = {"bundle adjustment": static_scene, "frame pairs": frame_pairs, "non-rigid": moving_points}
every_problem = pytest.mark.parametrize("make", PROBLEMS.values(), ids=PROBLEMS)
every_kernel = pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: k.kind)
every_way = pytest.mark.parametrize(("native", "stacked"), HOW, ids=HOW_IDS)


@every_way
@every_kernel
@every_problem
def test_energy_is_the_problems(
    rng: np.random.Generator, make: Make, kernel: Kernel, native: bool, stacked: bool
) -> None:
    problem, state = make(rng, kernel)
    graph, values = to_gtsam(problem, state, native=native, stacked=stacked)
    np.testing.assert_allclose(graph.error(values), problem.energy(state), rtol=1e-9)
    # Somewhere else as well, as far as it may move.
    step = {v: np.where(m, rng.normal(scale=1e-3, size=m.shape), 0.0) for v, m in problem.free.items()}
    moved = state.retract(step)
    assert abs(problem.energy(moved) / problem.energy(state) - 1.0) > 1e-6
    there = moved.to_values({v: np.isin(moved.keys(v), list(values.keys())) for v in moved.arrays})
    np.testing.assert_allclose(graph.error(there), problem.energy(moved), rtol=1e-9)


@every_problem
def test_native_factors_are_used_where_there_are_equal_ones(rng: np.random.Generator, make: Make) -> None:
    problem, state = make(rng, Kernel("huber", 1.0))
    graph, _ = to_gtsam(problem, state)
    kinds = [type(graph.at(i)).__name__ for i in range(graph.size())]
    count = {b.factor_type.name: int((b.weight > 0).sum()) for b in problem.batches}
    assert kinds.count("GeneralSFMFactor2Cal3_S2") == count.get("static_reprojection", 0)
    assert kinds.count("BetweenFactorPoint3") == count.get("velocity_smoothness", 0)
    assert kinds.count("PriorFactorVector") == (10 if LOG_SCALE in state else 0)
    custom, _ = to_gtsam(problem, state, native=False)
    assert {type(custom.at(i)).__name__ for i in range(custom.size())} <= {
        "CustomFactor", "PriorFactorPose3", "PriorFactorCal3_S2", "PriorFactorPoint3",
    }  # fmt: skip


def test_stacking_makes_one_factor_per_landmark(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    alone, _ = to_gtsam(problem, state, native=False, stacked=False)
    stacked, _ = to_gtsam(problem, state, native=False)
    skew = 1
    assert alone.size() == sum(len(b) for b in problem.batches) + skew
    landmarks = len(np.unique(problem.batches[0].slots[1].rows))
    assert stacked.size() == landmarks + len(problem.batches[1]) + 1 + skew


def test_stacking_by_two_slots_makes_one_factor_per_pair(rng: np.random.Generator) -> None:
    problem, state = frame_pairs(rng, Kernel())
    pairs = {(s, t) for s, t in zip(*(slot.rows.tolist() for slot in problem.batches[0].slots[:2]), strict=True)}
    assert len(pairs) < len(problem.batches[0])
    assert len(list(gtsam_factors(problem.batches[0], state))) == len(pairs)


def dense_system(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[np.ndarray, np.ndarray]:
    """Return Hessian and gradient on the entries of our tangents, keys in ascending order."""
    ordering, columns, start = gtsam.Ordering(), [], 0
    for key in list(values.keys()):
        ordering.push_back(key)
        variable = locate(key)[0]
        columns += [start + c for c in variable.gtsam_columns or range(variable.dim)]
        start += variable.gtsam_dim or variable.dim
    hessian, minus_gradient = graph.linearize(values).hessian(ordering)
    return hessian[np.ix_(columns, columns)], -minus_gradient[columns]


@every_problem
def test_stacked_equals_unstacked(rng: np.random.Generator, make: Make) -> None:
    problem, state = make(rng, Kernel("cauchy", 1.5))
    systems = [dense_system(*to_gtsam(problem, state, native=False, stacked=s)) for s in (False, True)]
    for one, other in zip(*systems, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(one).max())


@pytest.mark.parametrize("native", [True, False])
def test_quadratic_hessian_and_gradient_are_those_of_the_batches(rng: np.random.Generator, native: bool) -> None:
    problem, state = bundle(rng, depth=True)
    problem = replace(problem, batches=tuple(replace(b, kernel=Kernel()) for b in problem.batches))
    objective = SchurObjective(problem, state, SolverConfig())
    linearization = objective.linearize(state)
    graph, values = to_gtsam(problem, state, native=native)
    hessian, gradient = dense_system(graph, values)
    keys = list(values.keys())
    widths = [locate(key)[0].dim for key in keys]
    start = dict(zip(keys, np.cumsum([0, *widths[:-1]]).tolist(), strict=True))
    ours, theirs = [], []
    for variable in objective.layout.offset:
        for row, key in enumerate(state.keys(variable)):
            ours.append(objective.layout.columns(variable, np.array(row)))
            theirs.append(start[key] + np.arange(variable.dim))
    mine, other = np.concatenate(ours), np.concatenate(theirs)
    scale = np.abs(hessian).max()
    np.testing.assert_allclose(
        linearization.hessian[np.ix_(mine, mine)], hessian[np.ix_(other, other)], atol=1e-12 * scale
    )
    np.testing.assert_allclose(linearization.gradient[mine], gradient[other], atol=1e-11 * np.sqrt(scale))
    np.testing.assert_allclose(linearization.gradient_max, np.abs(gradient).max(), rtol=1e-10)


@every_kernel
def test_jacobians_of_a_stacked_robust_factor(rng: np.random.Generator, kernel: Kernel) -> None:
    problem, state = bundle(rng, kernel=kernel, outliers=20)
    batch = problem.batches[0]
    rows = np.flatnonzero(batch.slots[1].rows == 4)
    weighted = replace(batch, weight=rng.uniform(0.2, 2.0, len(batch))).take(rows)
    (factor,) = gtsam_factors(weighted, state, native=False)
    values = state.to_values()
    linear = factor.linearize(values)
    keys = list(linear.keys())
    jacobian, start = linear.getA(), 0
    assert {locate(key)[0] for key in keys} == {POSE, LANDMARK, INTRINSICS}
    read = {POSE: values.atPose3, LANDMARK: values.atPoint3, INTRINSICS: values.atCal3_S2}
    for key in keys:
        variable = locate(key)[0]

        def error(value: gtsam.Pose3 | gtsam.Cal3_S2 | np.ndarray, key: int = key) -> np.ndarray:
            moved = gtsam.Values(values)
            moved.update(key, value)
            return factor.unwhitenedError(moved)

        numerical = numericalDerivative11(error, read[variable](key), 1e-6)
        width = numerical.shape[1]
        ours = jacobian[:, start : start + width]
        np.testing.assert_allclose(ours, numerical, atol=1e-6 * max(1.0, np.abs(ours).max()))
        start += width
    assert start == jacobian.shape[1]


# --- what is held -------------------------------------------------------------------------------------------


def places(keys: list[int]) -> set[tuple[VariableType, int]]:
    return {(locate(key)[0], locate(key)[1][0]) for key in keys}


def test_frozen_variables_are_held_where_they_are(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    free = {LANDMARK: problem.free[LANDMARK], POSE: problem.free[POSE].copy()}
    free[POSE][:2] = False
    frozen = replace(problem, free=free)
    graph, values = to_gtsam(frozen, state)
    priors = [graph.at(i) for i in range(graph.size()) if type(graph.at(i)) in (
        gtsam.PriorFactorPose3, gtsam.PriorFactorCal3_S2)]  # fmt: skip
    held = [factor.keys()[0] for factor in priors]
    assert sorted(held) == sorted([POSE.key(0), POSE.key(1), INTRINSICS.key(0), INTRINSICS.key(0)])
    energy = problem.energy(state)
    np.testing.assert_allclose(graph.error(values), energy, rtol=1e-12)
    values.update(POSE.key(0), values.atPose3(POSE.key(0)).retract(np.array([0, 0, 0, 1e-3, 0, 0])))
    np.testing.assert_allclose(graph.error(values) - energy, 0.5 * (1e-3 / HELD_SIGMA) ** 2, rtol=1e-2)
    free[POSE][0, :3] = True
    graph, values = to_gtsam(frozen, state)
    values.update(POSE.key(0), values.atPose3(POSE.key(0)).retract(np.array([1e-3, 0, 0, 0, 0, 0])))
    moved = state.replace({POSE: se3.retract(state[POSE], 1e-3 * np.eye(5, 6) * np.eye(5)[:, :1])})
    np.testing.assert_allclose(graph.error(values), problem.energy(moved), rtol=1e-9)


def test_rows_without_a_weight_and_what_only_they_read_are_left_out(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    reprojection, prior, intrinsics = problem.batches
    off = reprojection.slots[1].rows == 5
    batches = (replace(reprojection, weight=np.where(off, 0.0, 1.0)), prior.take(np.arange(6, 24)), intrinsics)
    some = replace(problem, batches=batches)
    for native in (True, False):
        graph, values = to_gtsam(some, state, native=native)
        found = places(list(values.keys()))
        assert (LANDMARK, 10 + 3 * 5) not in found
        assert (LANDMARK, 10 + 3 * 4) in found
        assert set(values.keys()) == set(graph.keyVector())
        np.testing.assert_allclose(graph.error(values), some.energy(state), rtol=1e-12)
    none = replace(problem, batches=(replace(reprojection, weight=np.zeros(len(reprojection))),))
    graph, values = to_gtsam(none, state)
    assert (graph.size(), values.size()) == (0, 0)


@every_problem
def test_names_are_unique_and_values_are_read_back(rng: np.random.Generator, make: Make) -> None:
    problem, state = make(rng, Kernel())
    graph, values = to_gtsam(problem, state)
    keys = list(values.keys())
    assert set(keys) == set(graph.keyVector())
    assert len({format_key(key) for key in keys}) == len(keys)
    back = State.from_values(values)
    rows = {variable: state.rows_of(back.keys(variable)) for variable in back.arrays}
    assert set(back.arrays) == set(state.arrays)
    for variable, found in rows.items():
        np.testing.assert_allclose(back[variable], state[variable][[row for _, row in found]], rtol=1e-15, atol=1e-15)
    assert sum(len(a) for a in back.arrays.values()) == len(keys)


# --- solving ------------------------------------------------------------------------------------------------


def gtsam_minimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(300)
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


@pytest.mark.parametrize("native", [True, False], ids=["native", "custom"])
@every_problem
def test_gtsams_optimizer_reaches_our_minimum(rng: np.random.Generator, make: Make, native: bool) -> None:
    problem, state = make(rng, Kernel("huber", 1.5))
    eliminate = LANDMARK if LANDMARK in state else None
    ours, summary = minimize(SchurObjective(problem, state, TIGHT, eliminate), state, TIGHT)
    assert summary.initial_energy > 1.5 * summary.final_energy
    found = state.with_values(gtsam_minimum(*to_gtsam(problem, state, native=native)))
    np.testing.assert_allclose(problem.energy(found), summary.final_energy, rtol=1e-8)
    for variable in state.arrays:
        scale = 500.0 if variable is INTRINSICS else 1.0
        np.testing.assert_allclose(found[variable], ours[variable], atol=1e-5 * scale)
    for variable, free in problem.free.items():
        if variable is not POSE:
            np.testing.assert_allclose(found[variable][~free], state[variable][~free], atol=1e-5)
    if POSE in state:
        np.testing.assert_allclose(found[POSE][0], state[POSE][0], atol=1e-5)


@pytest.mark.parametrize("native", [True, False], ids=["native", "custom"])
def test_a_partly_free_calibration_is_not_freed(rng: np.random.Generator, native: bool) -> None:
    problem, state = bundle(rng)
    problem.fix(INTRINSICS, entries=[1, 2, 3])
    graph, values = to_gtsam(problem, state, native=native)
    solved = gtsam_minimum(graph, values).atCal3_S2(INTRINSICS.key(0)).vector()
    fx, fy, skew, cx, cy = solved
    np.testing.assert_allclose([fy, cx, cy], state[INTRINSICS][0, 1:], atol=1e-5)
    assert abs(skew) < 1e-5
    assert abs(fx - state[INTRINSICS][0, 0]) > 1.0
    ours, _ = minimize(SchurObjective(problem, state, TIGHT), state, TIGHT)
    np.testing.assert_allclose(fx, ours[INTRINSICS][0, 0], atol=1e-3)


# --- guards -------------------------------------------------------------------------------------------------


def test_wrong_jacobian_is_refused_inside_gtsam(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    batch = problem.batches[1]
    wide = replace(batch.factor_type, linearize=lambda v, measured: (v - measured, [np.ones((len(v), 3, 2))]))
    graph, values = to_gtsam(Problem((replace(batch, factor_type=wide),), problem.free), state)
    with pytest.raises(SolverError, match=r"landmark_prior: Jacobian of landmark is \(1, 3, 2\), not \(1, 3, 3\)"):
        GraphObjective(graph).linearize(values)


def test_missing_cue_is_named_inside_gtsam(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    batch = problem.batches[0]
    uv = batch.data["uv"].copy()
    uv[7] = np.nan
    broken = first_batch(problem, replace(batch, data={"uv": uv}))
    graph, values = to_gtsam(broken, state, native=False)
    with pytest.raises(SolverError, match=r"static_reprojection: .* camera pose, frame 0 and landmark, track \d+"):
        GraphObjective(graph).linearize(values)
    graph, values = to_gtsam(broken, state)
    landmark = state.describe(LANDMARK, int(batch.slots[1].rows[7]))
    with pytest.raises(SolverError, match=f"factor 7 on camera pose, frame 0 and {landmark} and intrinsics, camera 0"):
        GraphObjective(graph).linearize(values)


def test_a_factor_that_reads_one_variable_twice(rng: np.random.Generator) -> None:
    """Its two Jacobians add up: GTSAM takes each key of a factor once."""
    state = State({DYNAMIC_POINT: rng.normal(size=(3, 3))})
    twice = velocity_smoothness([0, 1], [0, 2], sigma=0.3)
    prior = FactorBatch.create(POINT_PRIOR, (slot(np.arange(3)),), {"measured": np.zeros((3, 3))})
    problem = Problem((twice, prior), all_free(state, DYNAMIC_POINT))
    for stacked in (True, False):
        graph, values = to_gtsam(problem, state, native=False, stacked=stacked)
        np.testing.assert_allclose(graph.error(values), problem.energy(state), rtol=1e-12)
        hessian, _ = dense_system(graph, values)
        expected = np.eye(9)
        expected[3:, 3:] += np.kron([[1, -1], [-1, 1]], np.eye(3)) / 0.09
        np.testing.assert_allclose(hessian, expected, atol=1e-12)
