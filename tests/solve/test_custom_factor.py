"""Factor batches as GTSAM custom factors: energy, Jacobians, Hessian, stacking, frozen variables, guards."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.utils.numerical_derivative import numericalDerivative11
from solve_samples import bundle, trajectories

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorBatch, Kernel
from uni4d_fg.factors.custom_factor import make_custom_factor, to_factor_graph
from uni4d_fg.graph.keys import decode
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import State
from uni4d_fg.solve.gaussian_graph import GraphObjective
from uni4d_fg.solve.schur import SchurObjective

STACKED = {"static_reprojection": "landmark", "depth_prior": "pose"}
KERNELS = [Kernel(), Kernel("huber", 1.0), Kernel("pseudo_huber", 1.0), Kernel("cauchy", 2.0), Kernel("norm", 0.1)]


def first_batch(problem: Problem, batch: FactorBatch) -> Problem:
    return replace(problem, batches=(batch, *problem.batches[1:]))


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: k.kind)
@pytest.mark.parametrize("stack", [None, STACKED], ids=["one by one", "stacked"])
def test_energy_is_the_problems(rng: np.random.Generator, kernel: Kernel, stack: dict[str, str] | None) -> None:
    problem, state = bundle(rng, kernel=kernel, outliers=6, depth=True)
    weighted = replace(problem.batches[0], weight=rng.uniform(0.0, 2.0, len(problem.batches[0])))
    problem = first_batch(problem, weighted)
    graph = to_factor_graph(problem, state, stack)
    np.testing.assert_allclose(graph.error(state.to_values()), sum(problem.energies(state).values()), rtol=1e-12)


def test_stacking_makes_one_factor_per_row_of_the_group(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    alone, stacked = to_factor_graph(problem, state), to_factor_graph(problem, state, STACKED)
    assert alone.size() == sum(len(b) for b in problem.batches)
    landmarks = len(np.unique(problem.batches[0].slots[1].rows))
    assert stacked.size() == landmarks + len(problem.batches[1]) + 1


def test_stacked_equals_unstacked(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, kernel=Kernel("cauchy", 1.5), outliers=5, depth=True)
    values = state.to_values()
    ordering = gtsam.Ordering()
    for key in list(values.keys()):
        ordering.push_back(key)
    systems = [to_factor_graph(problem, state, s).linearize(values).hessian(ordering) for s in (None, STACKED)]
    scale = np.abs(systems[0][0]).max()
    np.testing.assert_allclose(systems[0][0], systems[1][0], atol=1e-12 * scale)
    np.testing.assert_allclose(systems[0][1], systems[1][1], atol=1e-12 * np.abs(systems[0][1]).max())


def test_quadratic_hessian_and_gradient_are_those_of_the_batches(rng: np.random.Generator) -> None:
    problem, state = bundle(rng, depth=True)
    quadratic = tuple(replace(b, kernel=Kernel()) for b in problem.batches)
    problem = replace(problem, batches=quadratic)
    objective = SchurObjective(problem, state, SolverConfig())
    linearization = objective.linearize(state)
    values = state.to_values()
    ordering = gtsam.Ordering()
    columns = []
    for group in objective.layout.offset:
        for row in range(len(state[group])):
            ordering.push_back(state.key(group, row))
            columns.append(objective.layout.columns(group, np.array(row)))
    for row in range(len(state["landmark"])):
        ordering.push_back(state.key("landmark", row))
    hessian, minus_gradient = to_factor_graph(problem, state).linearize(values).hessian(ordering)
    order = np.concatenate(columns)
    n = len(order)
    scale = np.abs(hessian).max()
    np.testing.assert_allclose(linearization.hessian[np.ix_(order, order)], hessian[:n, :n], atol=1e-12 * scale)
    np.testing.assert_allclose(linearization.gradient[order], -minus_gradient[:n], atol=1e-11 * np.sqrt(scale))
    gradient = np.abs(minus_gradient).max()
    np.testing.assert_allclose(linearization.gradient_max, gradient, rtol=1e-10)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: k.kind)
def test_jacobians_of_a_stacked_robust_factor(rng: np.random.Generator, kernel: Kernel) -> None:
    problem, state = bundle(rng, kernel=kernel, outliers=20)
    batch = problem.batches[0]
    rows = np.flatnonzero(batch.slots[1].rows == 4)
    weighted = replace(batch, weight=rng.uniform(0.2, 2.0, len(batch))).take(rows)
    factor = make_custom_factor(weighted, state, problem.free_rows())
    assert factor is not None
    values = state.to_values()
    linear = factor.linearize(values)
    keys = list(linear.keys())
    jacobian, start = linear.getA(), 0
    assert {decode(key).group for key in keys} == {"pose", "landmark", "intrinsics"}
    for key in keys:
        group = decode(key).group
        at = (
            values.atPose3(key)
            if group == "pose"
            else np.asarray(values.atPoint3(key) if group == "landmark" else values.atVector(key))
        )

        def error(variable: gtsam.Pose3 | np.ndarray, key: int = key) -> np.ndarray:
            moved = gtsam.Values(values)
            moved.update(key, variable)
            return factor.unwhitenedError(moved)

        numerical = numericalDerivative11(error, at, 1e-6)
        width = numerical.shape[1]
        ours = jacobian[:, start : start + width]
        np.testing.assert_allclose(ours, numerical, atol=1e-6 * max(1.0, np.abs(ours).max()))
        start += width
    assert start == jacobian.shape[1]


def test_frozen_variables_are_constants(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    free = {"landmark": problem.free["landmark"], "pose": problem.free["pose"].copy()}
    free["pose"][:2] = False
    frozen = replace(problem, free=free)
    graph = to_factor_graph(frozen, state, STACKED)
    read = {(decode(key).group, decode(key).index) for key in list(graph.keyVector())}
    assert ("intrinsics", 0) not in read
    assert ("pose", 0) not in read
    assert ("pose", 2) in read
    values = state.to_values(frozen.free_rows())
    energies = problem.energies(state)
    expected = energies["static_reprojection"] + energies["landmark_prior"]
    np.testing.assert_allclose(graph.error(values), expected, rtol=1e-12)
    moved = State({**state.groups, "intrinsics": state["intrinsics"] * 2}, state.names)
    np.testing.assert_allclose(graph.error(moved.to_values(frozen.free_rows())), expected, rtol=1e-12)


def test_a_batch_of_frozen_variables_is_left_out(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    assert make_custom_factor(problem.batches[2], state, {"pose": np.ones(5, dtype=bool)}) is None


def test_stacking_by_a_group_that_is_not_read_is_refused(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    with pytest.raises(SolverError, match="arap: cannot be stacked by landmark"):
        to_factor_graph(problem, state, {"arap": "landmark"})


def test_wrong_jacobian_is_refused_inside_gtsam(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    batch = problem.batches[1]
    wide = replace(batch.family, linearize=lambda v, measured: (v - measured, [np.ones((len(v), 3, 2))]))
    graph = to_factor_graph(Problem((replace(batch, family=wide),), problem.free), state)
    with pytest.raises(SolverError, match=r"landmark_prior: Jacobian of landmark is \(1, 3, 2\), not \(1, 3, 3\)"):
        GraphObjective(graph).linearize(state.to_values())


def test_missing_cue_is_named_inside_gtsam(rng: np.random.Generator) -> None:
    problem, state = bundle(rng)
    batch = problem.batches[0]
    uv = batch.data["uv"].copy()
    uv[7] = np.nan
    graph = to_factor_graph(first_batch(problem, replace(batch, data={"uv": uv})), state)
    with pytest.raises(SolverError, match=r"static_reprojection: .* camera pose, frame 0 and landmark, track \d+"):
        GraphObjective(graph).linearize(state.to_values())
