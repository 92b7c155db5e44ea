"""Normal equations of many moving points against those of NumPy, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from uni4d_fg_cpp import _core

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.depth_prior import dynamic_depth_prior
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness, velocity_smoothness
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.geometry import se3
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.trajectory_cg import TrajectoryObjective

KERNELS = ("quadratic", "huber", "pseudo_huber", "cauchy", "norm")
EXACT = SolverConfig(cg_tolerance=1e-12, cg_max_iterations=5000)
ADD = {
    dynamic_reprojection: "add_dynamic_reprojection",
    dynamic_depth_prior: "add_dynamic_depth_prior",
    velocity_smoothness: "add_smoothness",
    acceleration_smoothness: "add_smoothness",
    arap: "add_arap",
}


def make_problem(seed: int, lengths: list[int], kernel: str, *, scrambled: bool, behind: bool) -> tuple[Problem, State]:
    """Every family with random rows, noise, weights and cameras; with ``scrambled`` rows of any track and frame."""
    rng = np.random.default_rng(seed)
    track = np.repeat(np.arange(len(lengths)), lengths)
    count = len(track)
    points = rng.normal(size=(count, 3)) + np.array([0.0, 0.0, -1.0 if behind else 4.0])
    if count > 1:
        points[-1] = points[0]  # coinciding points
    names = np.stack([5 * track, np.concatenate([np.arange(n) for n in lengths])], axis=1)
    state = State({DYNAMIC_POINT: points}, {DYNAMIC_POINT: names})
    poses = se3.se3_exp(0.1 * rng.normal(size=(4, 6)))

    def batch(family: Any, rows: list[np.ndarray], data: dict[str, np.ndarray]) -> FactorBatch:
        n = len(rows[0])
        return FactorBatch.create(
            family,
            tuple(Slot(DYNAMIC_POINT, r) for r in rows),
            data,
            sigma=rng.uniform(0.5, 2.0, (n, family.dim) if seed % 2 else n),
            weight=rng.uniform(0.1, 2.0, n),
            kernel=Kernel(kernel, 0.3),  # type: ignore[arg-type]
        )

    own, camera = rng.permutation(count), rng.integers(0, 4, count)
    intrinsics = np.tile([300.0, 310.0, 160.0, 120.0], (count, 1))
    batches = [
        batch(
            dynamic_reprojection,
            [own],
            {"uv": rng.uniform(0, 300, (count, 2)), "world_T_cam": poses[camera], "intrinsics": intrinsics},
        ),
        batch(
            dynamic_depth_prior,
            [own],
            {"depth": rng.uniform(1, 5, count), "world_T_cam": poses[camera], "log_scale": rng.normal(size=count)},
        ),
    ]
    for family, slots in ((velocity_smoothness, 2), (acceleration_smoothness, 3), (arap, 4)):
        if scrambled:
            rows = [rng.integers(0, count, 12) for _ in range(slots)]
        elif slots == 4:
            k, m = rng.integers(0, count, (2, 40))
            usable = (k + 1 < count) & (m + 1 < count)
            usable[usable] &= (track[k[usable]] == track[k[usable] + 1]) & (track[m[usable]] == track[m[usable] + 1])
            usable &= track[k] != track[m]
            k, m = k[usable], m[usable]
            rows = [k, m, k + 1, m + 1]
        else:
            first = np.arange(max(count - slots + 1, 0))
            first = first[track[first] == track[first + slots - 1]]
            rows = [first + i for i in range(slots)]
        if len(rows[0]):
            batches.append(batch(family, rows, {}))
    return Problem(tuple(batches), all_free(state, DYNAMIC_POINT)), state


def add(system: _core.TrajectorySystem, batch: FactorBatch) -> None:
    getattr(system, ADD[batch.factor_type])(
        rows=[s.rows for s in batch.slots],
        **{name: np.ascontiguousarray(array) for name, array in batch.data.items()},
        sigma=np.ascontiguousarray(batch.sigma),
        weight=np.ascontiguousarray(batch.weight),
        kernel=KERNELS.index(batch.kernel.kind),
        threshold=batch.kernel.threshold,
    )


def system_of(problem: Problem, state: State, threads: int = 2) -> _core.TrajectorySystem:
    system = _core.TrajectorySystem(np.ascontiguousarray(state.numbers(DYNAMIC_POINT)[:, 0]), threads)
    for batch in problem.batches:
        add(system, batch)
    system.plan()
    return system


def assert_close(ours: np.ndarray, reference: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(ours, reference, rtol=tolerance, atol=tolerance * np.abs(reference).max(initial=1e-300))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=6),
    kernel=st.sampled_from(KERNELS),
    scrambled=st.booleans(),
    behind=st.booleans(),
    curvature=st.sampled_from((0.0, 0.4, 0.9)),
)
def test_parity_with_numpy(
    seed: int, lengths: list[int], kernel: str, scrambled: bool, behind: bool, curvature: float
) -> None:
    problem, state = make_problem(seed, lengths, kernel, scrambled=scrambled, behind=behind)
    config = EXACT.model_copy(update={"kernel_curvature": curvature})
    system, reference = system_of(problem, state), TrajectoryObjective(problem, state, config, threads=1)
    points = state[DYNAMIC_POINT]
    expected = [batch.energy(state) for batch in problem.batches]
    np.testing.assert_allclose(system.energies(points), expected, rtol=1e-12, atol=1e-12 * max(expected))
    gradient, failure = system.linearize(points, curvature)
    linearization = reference.linearize_curved(state)
    assert failure is None
    assert_close(gradient, linearization.gradient, 1e-10)
    vector = np.random.default_rng(seed).normal(size=len(gradient))
    assert_close(system.multiply(vector), linearization.multiply(vector), 1e-10)
    diagonal = np.stack([np.diag(block) for block in system.diagonal_blocks()]).reshape(-1)
    assert_close(diagonal, linearization.bands[0], 1e-10)
    step = linearization.solve(0.1)
    result = system.solve(0.1, EXACT.min_diagonal, EXACT.max_diagonal, EXACT.cg_tolerance, EXACT.cg_max_iterations)
    assert (step is None) == (result is None)
    if step is not None:
        delta, norm, decrease, _ = result
        assert_close(delta, step.delta, 1e-7)
        assert norm == pytest.approx(step.norm, rel=1e-8)
        assert decrease == pytest.approx(step.predicted_decrease, rel=1e-8)


@pytest.mark.parametrize("scrambled", [False, True])
def test_other_weights_and_kernels_need_no_new_plan(scrambled: bool) -> None:
    problem, state = make_problem(4, [9, 3, 7, 8], "huber", scrambled=scrambled, behind=False)
    system, points = system_of(problem, state), state[DYNAMIC_POINT]
    system.linearize(points)
    rng = np.random.default_rng(0)
    kernels = [Kernel("norm", 0.2), Kernel("cauchy", 2.0), Kernel(), Kernel("huber", 0.1), Kernel("pseudo_huber", 1.0)]
    batches = tuple(
        replace(batch, weight=rng.uniform(0.0, 3.0, len(batch)), kernel=kernel)
        for batch, kernel in zip(problem.batches, kernels, strict=True)
    )
    for i, batch in enumerate(batches):
        system.reweight(i, batch.weight, KERNELS.index(batch.kernel.kind), batch.kernel.threshold)
    with pytest.raises(ValueError, match=r"linearize\(\) must succeed before solve\(\)"):
        system.solve(1e-3, 1e-6, 1e32, 0.1, 10)
    fresh = system_of(replace(problem, batches=batches), state)
    np.testing.assert_array_equal(system.energies(points), fresh.energies(points))
    np.testing.assert_array_equal(system.linearize(points, 0.5)[0], fresh.linearize(points, 0.5)[0])
    np.testing.assert_array_equal(system.solve(1e-3, 1e-6, 1e32, 0.1, 10)[0], fresh.solve(1e-3, 1e-6, 1e32, 0.1, 10)[0])
    for arguments, message in (
        ((5, batch.weight, 0, 1.0), "batch: there is none of this number"),
        ((0, batch.weight[:1], 0, 1.0), "weight: expected"),
        ((4, -1.0 - batch.weight, 0, 1.0), "weight"),
        ((4, batch.weight, 9, 1.0), "kernel"),
    ):
        with pytest.raises(ValueError, match=message):
            system.reweight(*arguments)


def test_every_number_of_threads_gives_the_same_bits() -> None:
    problem, state = make_problem(3, [60] * 40, "huber", scrambled=False, behind=False)
    results = []
    for threads in (1, 2, 3, 2):
        system = system_of(problem, state, threads)
        gradient, _ = system.linearize(state[DYNAMIC_POINT])
        delta, *rest = system.solve(1e-3, 1e-6, 1e32, 1e-3, 100)
        results.append((system.energies(state[DYNAMIC_POINT]), gradient, delta, np.array(rest)))
    for other in results[1:]:
        for mine, theirs in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_the_first_factor_that_is_not_finite_is_reported() -> None:
    problem, state = make_problem(5, [6, 7, 8], "huber", scrambled=False, behind=False)
    system, points = system_of(problem, state), state[DYNAMIC_POINT].copy()
    points[4, 1] = np.nan
    _, failure = system.linearize(points)
    assert failure == (0, int(np.flatnonzero(problem.batches[0].slots[0].rows == 4)[0]))
    assert np.isnan(system.energies(points)).any()
    with pytest.raises(ValueError, match=r"linearize\(\) must succeed before solve\(\)"):
        system.solve(1e-3, 1e-6, 1e32, 0.1, 10)


def test_no_points_and_no_factors() -> None:
    system = _core.TrajectorySystem(np.zeros(0, dtype=np.int64))
    system.plan()
    gradient, failure = system.linearize(np.zeros((0, 3)))
    assert gradient.shape == (0,)
    assert failure is None
    assert system.energies(np.zeros((0, 3))).shape == (0,)
    delta, norm, decrease, iterations = system.solve(1.0, 1e-6, 1e32, 0.1, 10)
    assert (delta.shape, norm, decrease, iterations) == ((0,), 0.0, 0.0, 0)


def test_a_matrix_that_is_not_positive_gives_no_step() -> None:
    system = _core.TrajectorySystem(np.zeros(2, dtype=np.int64))
    system.plan()
    system.linearize(np.zeros((2, 3)))
    assert system.solve(0.0, 0.0, 1.0, 0.1, 10) is None


def test_order_of_calls_and_arguments_are_checked() -> None:
    track = np.array([0, 0, 1])
    system = _core.TrajectorySystem(track)
    with pytest.raises(ValueError, match=r"call plan\(\) first"):
        system.linearize(np.zeros((3, 3)))
    noise = {"sigma": np.ones(1), "weight": np.ones(1), "kernel": 0, "threshold": 1.0}
    one = np.zeros(1, dtype=np.int64)
    with pytest.raises(ValueError, match="rows: expected 4 arrays, one per slot, got 3"):
        system.add_arap(rows=[one] * 3, **noise)
    with pytest.raises(ValueError, match="rows: expected 2 or 3 arrays"):
        system.add_smoothness(rows=[one] * 4, **noise)
    with pytest.raises(ValueError, match=r"rows\[1\]: entry 0 is 3, outside \[0, 3\)"):
        system.add_smoothness(rows=[one, one + 3], **noise)
    with pytest.raises(ValueError, match=r"rows\[1\]: expected int64 \(1,\)"):
        system.add_smoothness(rows=[one, np.zeros(2, dtype=np.int64)], **noise)
    system.plan()
    with pytest.raises(ValueError, match=r"plan\(\) can be called once"):
        system.plan()
    with pytest.raises(ValueError, match=r"no batch can be added after plan\(\)"):
        system.add_smoothness(rows=[one, one], **noise)
    system.linearize(np.zeros((3, 3)))
    for arguments, message in (
        ((np.nan, 0.0, 1.0, 0.1, 1), "damping"),
        ((1.0, 1.0, 0.0, 0.1, 1), "min_diagonal"),
        ((1.0, 0.0, 1.0, 1.0, 1), "cg_tolerance"),
        ((1.0, 0.0, 1.0, 0.1, 0), "cg_max_iterations"),
    ):
        with pytest.raises(ValueError, match=message):
            system.solve(*arguments)
    for curvature in (-0.1, 1.0, np.nan):
        with pytest.raises(ValueError, match="kernel_curvature: must be at least 0 and below 1"):
            system.linearize(np.zeros((3, 3)), curvature)
    with pytest.raises(ValueError, match="track: points of one track must be consecutive"):
        _core.TrajectorySystem(np.array([0, 1, 0]))
    with pytest.raises(ValueError, match="track: entry 0 is -1"):
        _core.TrajectorySystem(np.array([-1, 1]))


MALFORMED: dict[str, Any] = {
    "dtype": lambda a: a.astype(np.float32 if a.dtype.kind == "f" else np.int32),
    "extra axis": lambda a: a[None].copy(),
    "length": lambda a: np.concatenate([a, a[:1]]),
    "strides": lambda a: np.repeat(a, 2, axis=0)[::2],
    "value": lambda a: np.full_like(a, np.nan if a.dtype.kind == "f" else -7),
}


@pytest.mark.parametrize("spoil", MALFORMED)
@pytest.mark.parametrize("index", range(5))
def test_malformed_arrays_are_refused_by_name(index: int, spoil: str) -> None:
    problem, _ = make_problem(1, [5, 5, 5], "huber", scrambled=False, behind=False)
    batch = problem.batches[index]
    names = [*batch.data, "sigma", "weight", *(f"rows[{i}]" for i in range(len(batch.slots)))]
    for name in names:
        system = _core.TrajectorySystem(np.repeat(np.arange(3), 5))
        arguments: dict[str, Any] = {
            **{key: np.ascontiguousarray(array) for key, array in batch.data.items()},
            "rows": [s.rows.copy() for s in batch.slots],
            "sigma": np.ascontiguousarray(batch.sigma),
            "weight": np.ascontiguousarray(batch.weight),
        }
        if name.startswith("rows"):
            slot = int(name[5:-1])
            arguments["rows"][slot] = MALFORMED[spoil](arguments["rows"][slot])
        else:
            arguments[name] = MALFORMED[spoil](arguments[name])
        # When one of several lengths differs, another argument may be called wrong.
        blamed = None if spoil == "length" else name.replace("[", r"\[").replace("]", r"\]")
        with pytest.raises(ValueError, match=blamed):
            getattr(system, ADD[batch.factor_type])(**arguments, kernel=1, threshold=1.0)


@pytest.mark.parametrize("spoil", ["dtype", "extra axis", "length", "strides"])
def test_malformed_points_and_vectors_are_refused(spoil: str) -> None:
    problem, state = make_problem(1, [5, 5, 5], "huber", scrambled=False, behind=False)
    system, points = system_of(problem, state), state[DYNAMIC_POINT]
    for call in (system.energies, system.linearize):
        with pytest.raises(ValueError, match=r"points: expected float64 \(15, 3\)"):
            call(MALFORMED[spoil](points))
    system.linearize(points)
    with pytest.raises(ValueError, match=r"vector: expected float64 \(45,\)"):
        system.multiply(MALFORMED[spoil](np.zeros(45)))
    with pytest.raises(ValueError, match="vector: every value must be finite"):
        system.multiply(np.full(45, np.inf))
