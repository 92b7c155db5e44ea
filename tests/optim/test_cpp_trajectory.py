"""The C++ trajectory solver against the NumPy one: same energies, steps, messages and stage results."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from solve_samples import POINT_PRIOR, slot, trajectories

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorBatch, FactorType, Kernel, Slot
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, POSE
from uni4d_fg.optim.cpp_trajectory import CppTrajectoryObjective, refusal
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.trajectory_cg import TrajectoryObjective

pytest.importorskip("uni4d_fg_cpp", reason="needs the C++ extension: pip install ./cpp_factors")

EXACT = SolverConfig(cg_tolerance=1e-12, cg_max_iterations=5000, kernel_curvature=0.8)
KERNELS = [Kernel(), Kernel("huber", 1.3), Kernel("pseudo_huber", 2.0), Kernel("cauchy", 2.0), Kernel("norm", 0.1)]


@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: k.kind)
@pytest.mark.parametrize(("tracks", "frames"), [(1, 1), (1, 2), (1, 20), (5, 1), (6, 7)])
def test_energies_gradient_and_step(
    rng: np.random.Generator, kernel: Kernel, tracks: int, frames: int, curved: bool
) -> None:
    if frames < 3:
        problem, state = trajectories(rng, tracks, 3, kernel=kernel)
        problem, state = first_frames(problem, state, 3, frames)
    else:
        problem, state = trajectories(rng, tracks, frames, kernel=kernel)
    ours, reference = CppTrajectoryObjective(problem, state, EXACT), TrajectoryObjective(problem, state, EXACT)
    # Away from the start, at which residuals of the depth prior are rounding errors.
    state = state.replace({DYNAMIC_POINT: state[DYNAMIC_POINT] + 0.01 * rng.normal(size=state[DYNAMIC_POINT].shape)})
    expected = reference.energies(state)
    for term, energy in ours.energies(state).items():
        np.testing.assert_allclose(energy, expected[term], rtol=1e-12)
    mine, theirs = (o.linearize_curved(state) if curved else o.linearize(state) for o in (ours, reference))
    scale = np.abs(theirs.gradient).max()
    np.testing.assert_allclose(mine.gradient, theirs.gradient, rtol=1e-10, atol=1e-10 * scale)
    assert mine.gradient_max == np.abs(mine.gradient).max()
    vector = rng.normal(size=len(mine.gradient))
    product = theirs.multiply(vector)
    np.testing.assert_allclose(mine.multiply(vector), product, rtol=1e-10, atol=1e-12 * np.abs(product).max())
    step, other = mine.solve(1e-3), theirs.solve(1e-3)
    assert step is not None
    assert other is not None
    np.testing.assert_allclose(step.delta, other.delta, rtol=1e-8, atol=1e-8 * np.abs(other.delta).max())
    np.testing.assert_allclose(step.norm, other.norm, rtol=1e-8)
    np.testing.assert_allclose(step.predicted_decrease, other.predicted_decrease, rtol=1e-8)


def first_frames(problem: Problem, state: State, frames: int, kept: int) -> tuple[Problem, State]:
    """Cut a problem to the first frames of every track; factors that read others go."""
    names = state.numbers(DYNAMIC_POINT)
    stays = names[:, 1] < kept
    row = np.cumsum(stays) - 1
    batches = []
    for batch in problem.batches:
        keep = np.logical_and.reduce([stays[s.rows] for s in batch.slots])
        part = batch.take(np.flatnonzero(keep))
        batches.append(replace(part, slots=tuple(replace(s, rows=row[s.rows]) for s in part.slots)))
    state = State({DYNAMIC_POINT: state[DYNAMIC_POINT][stays]}, {DYNAMIC_POINT: names[stays]})
    return Problem(tuple(batches), {DYNAMIC_POINT: problem.free[DYNAMIC_POINT][stays]}), state


@pytest.mark.parametrize("kernel_curvature", [0.0, 0.7])
@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: k.kind)
def test_same_solution(rng: np.random.Generator, kernel: Kernel, kernel_curvature: float) -> None:
    problem, state = trajectories(rng, 12, 10, kernel=kernel)
    config = SolverConfig(
        relative_decrease=1e-8,
        max_iterations=100,
        kernel_curvature=kernel_curvature,
        cg_tolerance=1e-6,
        cg_max_iterations=2000,
    )
    ours, summary = minimize(CppTrajectoryObjective(problem, state, config), state, config)
    theirs, reference = minimize(TrajectoryObjective(problem, state, config), state, config)
    assert summary.initial_energy > 1.2 * summary.final_energy
    np.testing.assert_allclose(summary.final_energy, reference.final_energy, rtol=1e-6)
    assert len(summary.iterations) == len(reference.iterations)
    np.testing.assert_allclose(ours[DYNAMIC_POINT], theirs[DYNAMIC_POINT], atol=1e-6)


def test_reweighting_is_as_good_as_a_new_objective(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng, 12, 10)
    softer = tuple(replace(b, weight=0.1 * b.weight, kernel=Kernel("cauchy", 3.0)) for b in problem.batches)
    other = replace(problem, batches=softer)
    objective = CppTrajectoryObjective(problem, state, EXACT)
    minimize(objective, state, EXACT)
    objective.reweight(other)
    ours, summary = minimize(objective, state, EXACT)
    fresh, reference = minimize(CppTrajectoryObjective(other, state, EXACT), state, EXACT)
    np.testing.assert_array_equal(ours[DYNAMIC_POINT], fresh[DYNAMIC_POINT])
    assert summary.final_energies == reference.final_energies
    with pytest.raises(SolverError, match="the same factors in the same order"):
        objective.reweight(replace(problem, batches=problem.batches[1:]))


def test_points_behind_the_camera_come_back(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    points = state[DYNAMIC_POINT].copy()
    points[::5, 2] *= -0.2
    state = state.replace({DYNAMIC_POINT: points})
    config = SolverConfig(relative_decrease=1e-8, max_iterations=200, cg_tolerance=1e-6, cg_max_iterations=2000)
    ours, summary = minimize(CppTrajectoryObjective(problem, state, config), state, config)
    _, reference = minimize(TrajectoryObjective(problem, state, config), state, config)
    np.testing.assert_allclose(summary.final_energy, reference.final_energy, rtol=1e-6)
    assert (ours[DYNAMIC_POINT][:, 2] > 1.0).all()


def test_threads_and_repetition_change_no_bit(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng, num_tracks=60, num_frames=20)
    config = SolverConfig(max_iterations=5)
    solved = [
        minimize(CppTrajectoryObjective(problem, state, config, threads=threads), state, config)[0][DYNAMIC_POINT]
        for threads in (1, 2, 2)
    ]
    np.testing.assert_array_equal(solved[0], solved[1])
    np.testing.assert_array_equal(solved[0], solved[2])


def test_a_cue_that_is_not_finite_is_named_as_by_numpy(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    depth = problem.batches[1].data["depth"].copy()
    depth[9] = np.nan
    broken = replace(problem.batches[1], data={**problem.batches[1].data, "depth": depth})
    problem = replace(problem, batches=(problem.batches[0], broken, *problem.batches[2:]))
    with pytest.raises(SolverError) as theirs:
        TrajectoryObjective(problem, state, EXACT, threads=1).linearize(state)
    with pytest.raises(SolverError) as ours:
        CppTrajectoryObjective(problem, state, EXACT)
    assert str(ours.value) == str(theirs.value)
    assert "dynamic point, track 10, frame 2" in str(ours.value)


def test_a_point_that_is_not_finite_is_named_as_by_numpy(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    objective, reference = CppTrajectoryObjective(problem, state, EXACT), TrajectoryObjective(problem, state, EXACT)
    points = state[DYNAMIC_POINT].copy()
    points[12] = np.nan
    state = state.replace({DYNAMIC_POINT: points})
    with pytest.raises(SolverError) as theirs:
        reference.linearize(state)
    with pytest.raises(SolverError) as ours:
        objective.linearize(state)
    assert str(ours.value) == str(theirs.value)
    assert not np.isfinite(sum(objective.energies(state).values()))


def test_undetermined_points_are_named(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    ray_only = replace(problem, batches=problem.batches[:1])
    expected = TrajectoryObjective(ray_only, state, EXACT).diagnose(state)
    assert CppTrajectoryObjective(ray_only, state, EXACT).diagnose(state) == expected
    assert "dynamic point, track 0, frame 0 (factors: dynamic_reprojection)" in expected
    assert "No single variable" in CppTrajectoryObjective(problem, state, EXACT).diagnose(state)


def test_what_is_taken(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    assert refusal(problem) == ""
    assert refusal(problem, LANDMARK) == "some landmark variables are frozen"
    free = {DYNAMIC_POINT: problem.free[DYNAMIC_POINT].copy()}
    free[DYNAMIC_POINT][3] = False
    held = replace(problem, free=free)
    assert refusal(held) == "some dynamic_point variables are frozen"
    seen = FactorBatch.create(
        static_reprojection,
        (
            Slot(POSE, np.zeros(1, dtype=int)),
            Slot(LANDMARK, np.zeros(1, dtype=int)),
            Slot(INTRINSICS, np.zeros(1, int)),
        ),
        {"uv": np.zeros((1, 2))},
    )
    mixed = replace(problem, batches=(*problem.batches, seen))
    assert refusal(mixed) == "static_reprojection reads other variables than dynamic_point"
    for dim, width in ((17, 1), (3, 9)):
        many = FactorType("many", (DYNAMIC_POINT,) * width, {}, dim, lambda *points: points[0], listed=False)
        large = FactorBatch.create(many, tuple(slot(np.arange(3)) for _ in range(width)))
        assert refusal(replace(problem, batches=(*problem.batches, large))) == (
            "many has more than 8 variables or 16 residuals"
        )
    for refused in (held, mixed):
        with pytest.raises(SolverError, match=re.escape(f"does not take this problem: {refusal(refused)}")):
            CppTrajectoryObjective(refused, state, EXACT)


@pytest.mark.parametrize("curved", [False, True])
def test_a_factor_that_it_does_not_know_takes_part_linearized(rng: np.random.Generator, curved: bool) -> None:
    problem, state = trajectories(rng)
    rows = np.array([2, 7, 7, 30])
    measured = state[DYNAMIC_POINT][rows] + rng.normal(scale=0.1, size=(4, 3))
    prior = FactorBatch.create(
        POINT_PRIOR, (slot(rows),), {"measured": measured}, sigma=0.05, weight=0.7, kernel=Kernel("cauchy", 1.5)
    )
    other = replace(problem, batches=(prior, *problem.batches))
    assert refusal(other) == ""
    ours, reference = CppTrajectoryObjective(other, state, EXACT), TrajectoryObjective(other, state, EXACT)
    own, foreign = ours.parts()
    assert own.terms == tuple(batch.name for batch in problem.batches)
    assert (foreign.by, foreign.terms) == ("linearized blocks in the C++ trajectories", ("point_prior",))
    assert ours.energies(state) == pytest.approx(reference.energies(state), rel=1e-12, abs=1e-20)
    mine, theirs = (o.linearize_curved(state) if curved else o.linearize(state) for o in (ours, reference))
    scale = np.abs(theirs.gradient).max()
    np.testing.assert_allclose(mine.gradient, theirs.gradient, rtol=1e-10, atol=1e-10 * scale)
    step, expected = mine.solve(1e-3), theirs.solve(1e-3)
    assert step is not None
    assert expected is not None
    np.testing.assert_allclose(step.delta, expected.delta, rtol=1e-8, atol=1e-8 * np.abs(expected.delta).max())
    config = SolverConfig(relative_decrease=1e-8, max_iterations=100, cg_tolerance=1e-6, cg_max_iterations=2000)
    solved, summary = minimize(CppTrajectoryObjective(other, state, config), state, config)
    found, by_numpy = minimize(TrajectoryObjective(other, state, config), state, config)
    np.testing.assert_allclose(summary.final_energy, by_numpy.final_energy, rtol=1e-6)
    np.testing.assert_allclose(solved[DYNAMIC_POINT], found[DYNAMIC_POINT], atol=1e-6)
    without, _ = minimize(CppTrajectoryObjective(problem, state, config), state, config)
    assert np.abs(without[DYNAMIC_POINT][rows] - solved[DYNAMIC_POINT][rows]).max() > 1e-3


def test_batches_without_rows_and_of_one_name(rng: np.random.Generator) -> None:
    problem, state = trajectories(rng)
    half = len(problem.batches[3]) // 2
    parts = [problem.batches[3].take(np.arange(half)), problem.batches[3].take(np.arange(half, 2 * half))]
    empty = problem.batches[2].take(np.arange(0))
    split = replace(problem, batches=(empty, *problem.batches[:2], *parts))
    whole = replace(problem, batches=(*problem.batches[:2], problem.batches[3].take(np.arange(2 * half))))
    ours, reference = CppTrajectoryObjective(split, state, EXACT), TrajectoryObjective(whole, state, EXACT)
    energies = ours.energies(state)
    assert energies["smoothness"] == 0.0
    np.testing.assert_allclose(energies["arap"], reference.energies(state)["arap"], rtol=1e-12)
    theirs = reference.linearize(state).gradient
    np.testing.assert_allclose(ours.linearize(state).gradient, theirs, atol=1e-10 * np.abs(theirs).max())
