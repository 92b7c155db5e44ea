"""The C++ landmark system against the NumPy one: energies, normal equations, steps, solutions, messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from solve_samples import bundle, pair_terms

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorBatch, Kernel, Slot
from uni4d_fg.factors.camera_motion import CAMERA_ROTATION, CAMERA_TRANSLATION
from uni4d_fg.factors.depth_prior import STATIC_DEPTH_PRIOR
from uni4d_fg.factors.priors import SCALE_ANCHOR
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import State
from uni4d_fg.solve.levenberg_marquardt import minimize
from uni4d_fg.solve.schur import SchurObjective

pytest.importorskip("uni4d_fg_cpp")

from uni4d_fg.solve.cpp_schur import CppSchurObjective, supports

CONFIG = SolverConfig(min_diagonal=1e-9)
DAMPING = 1e-3
Sample = tuple[Problem, State]


def scene(rng: np.random.Generator, num_poses: int = 6, num_landmarks: int = 90, **options: object) -> Sample:
    """A bundle adjustment whose gauge is held by its first pose, and by its last where there is no depth."""
    options = {"kernel": Kernel("huber", 1.0), "outliers": 12, "depth": True, **options}
    problem, state = bundle(rng, num_poses, num_landmarks, **options)  # type: ignore[arg-type]
    free = {g: mask.copy() for g, mask in problem.free.items()}
    free["pose"][0] = False
    if not options["depth"]:
        free["pose"][-1] = False
    return Problem(tuple(b for b in problem.batches if b.name != "landmark_prior"), free), state


def changed(sample: Sample, change: Callable[[FactorBatch], FactorBatch]) -> Sample:
    return replace(sample[0], batches=tuple(change(b) for b in sample[0].batches)), sample[1]


def frozen(sample: Sample, **masks: object) -> Sample:
    """Freeze the given rows, or (rows, columns), of groups; everything for None."""
    free = {g: mask.copy() for g, mask in sample[0].free.items()}
    for group, where in masks.items():
        free[group][where if where is not None else slice(None)] = False
    return replace(sample[0], free=free), sample[1]


def per_row_noise(rng: np.random.Generator) -> Sample:
    def change(batch: FactorBatch) -> FactorBatch:
        n, d = len(batch), batch.family.residual_dim
        shape = (n, d) if batch.family == STATIC_REPROJECTION else (n,)
        weight = rng.uniform(0, 2, n) * (rng.uniform(size=n) < 0.9)
        return replace(batch, sigma=batch.sigma.mean() * rng.uniform(0.5, 2, shape), weight=weight)

    return changed(scene(rng), change)


def repeated(rng: np.random.Generator) -> Sample:
    """Some observations two or three times, in one batch and in others with other kernels."""
    problem, state = scene(rng)
    reprojection, _, depth, _ = problem.batches
    twice = reprojection.take(np.r_[np.arange(len(reprojection)), np.arange(40), np.arange(20)])
    other = replace(reprojection.take(np.arange(5, 70)), kernel=Kernel("cauchy", 2.0), term="other")
    more_depth = replace(depth.take(np.arange(3, 200, 2)), kernel=Kernel("norm", 0.1))
    return replace(problem, batches=(twice, *problem.batches[1:], other, more_depth)), state


def behind_the_camera(rng: np.random.Generator) -> Sample:
    problem, state = scene(rng)
    landmarks = state["landmark"].copy()
    landmarks[::7, 2] -= 6.0
    landmarks[3, 2] = 0.02
    return problem, state.replace(landmark=landmarks)


def some_without_depth(rng: np.random.Generator) -> Sample:
    return changed(scene(rng), lambda b: b.take(np.arange(0, len(b), 3)) if b.family == STATIC_DEPTH_PRIOR else b)


def depth_alone(rng: np.random.Generator) -> Sample:
    """Landmarks that only a depth prior sees, and one that nothing sees."""
    problem, state = scene(rng)
    reprojection = problem.batches[0]
    rows = reprojection.slots[1].rows
    kept = reprojection.take(np.flatnonzero((rows > 8) & (rows != 50)))
    unseen = changed((problem, state), lambda b: b.take(np.flatnonzero(b.slots[1].rows != 50)) if len(b) > 90 else b)
    return replace(unseen[0], batches=(kept, *unseen[0].batches[1:])), state


def empty_batches(rng: np.random.Generator) -> Sample:
    problem, state = scene(rng)
    empty = tuple(
        replace(b.take(np.zeros(0, dtype=np.int64)), term=f"empty {i}") for i, b in enumerate(problem.batches)
    )
    return replace(problem, batches=(*empty, *problem.batches)), state


def camera_terms(rng: np.random.Generator) -> Sample:
    """Terms on two and three poses besides those on landmarks, one reading a pose twice."""
    problem, state = scene(rng)
    n = len(state["pose"])
    three = tuple(Slot("pose", np.arange(i, n - 2 + i)) for i in range(3))
    floor = {"floor": np.full(n - 2, 0.01)}
    ends = (Slot("pose", np.array([1])), Slot("pose", np.array([n - 1])))
    return replace(
        problem,
        batches=(
            *problem.batches,
            FactorBatch.create(CAMERA_ROTATION, three, floor, sigma=0.1),
            FactorBatch.create(CAMERA_TRANSLATION, three, floor, sigma=0.1, kernel=Kernel("huber", 1.0)),
            FactorBatch.create(SCALE_ANCHOR, ends, {"distance": np.array([0.5])}, sigma=1e-2),
            pair_terms(rng, n, 40, True),
        ),
    ), state


def long_sequence(rng: np.random.Generator) -> Sample:
    """Short tracks along many frames: the camera system is stored as a band."""
    problem, state = scene(rng, 40, 300)
    first = rng.integers(-4, 40, 300)
    in_front = problem.batches[2].data["depth"] > 0.5

    def near(batch: FactorBatch) -> FactorBatch:
        if batch.family not in (STATIC_REPROJECTION, STATIC_DEPTH_PRIOR):
            return batch
        away = batch.slots[0].rows - first[batch.slots[1].rows]
        return batch.take(np.flatnonzero((away >= 0) & (away < 5) & in_front))

    return changed((problem, state), near)


def kernels(kind: str) -> Callable[[np.random.Generator], Sample]:
    kernel = Kernel(kind, 0.7)  # type: ignore[arg-type]
    return lambda rng: changed(scene(rng), lambda b: replace(b, kernel=kernel))


SAMPLES: dict[str, Callable[[np.random.Generator], Sample]] = {
    "depth": scene,
    "no depth": lambda rng: scene(rng, depth=False),
    "one landmark": lambda rng: scene(rng, 6, 1, outliers=0),
    "several chunks": lambda rng: scene(rng, 9, 300),
    "per-row noise": per_row_noise,
    "repeated": repeated,
    "behind the camera": behind_the_camera,
    "some without depth": some_without_depth,
    "depth alone": depth_alone,
    "empty batches": empty_batches,
    "camera terms": camera_terms,
    "long sequence": long_sequence,
    "frozen landmarks": lambda rng: frozen(scene(rng), landmark=slice(0, 90, 4)),
    "frozen intrinsics": lambda rng: frozen(scene(rng), intrinsics=None),
    "frozen centre": lambda rng: frozen(scene(rng), intrinsics=(slice(None), slice(2, 4))),
    "frozen entries": lambda rng: frozen(scene(rng), pose=(slice(2, 4), slice(1, 5)), log_scale=[1, 2]),
    "frozen poses": lambda rng: frozen(scene(rng), pose=None, intrinsics=None),
    "landmarks alone": lambda rng: frozen(scene(rng), pose=None, intrinsics=None, log_scale=None),
    **{f"kernel {k}": kernels(k) for k in ("quadratic", "huber", "pseudo_huber", "cauchy", "norm")},
}


@pytest.fixture(params=SAMPLES, ids=lambda name: name.replace(" ", "-"))
def sample(request: pytest.FixtureRequest, rng: np.random.Generator) -> Sample:
    return SAMPLES[request.param](rng)


def relative(ours: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference relative to the largest entry."""
    return float(np.abs(ours - expected).max(initial=0.0) / max(np.abs(expected).max(initial=0.0), 1e-300))


@pytest.mark.parametrize("threads", [1, 2])
def test_energies(sample: Sample, threads: int) -> None:
    problem, state = sample
    ours = CppSchurObjective(problem, state, CONFIG, threads=threads).energies(state)
    expected = problem.energies(state)
    assert list(ours) == list(expected)
    for term, energy in expected.items():
        np.testing.assert_allclose(ours[term], energy, rtol=1e-12)


@pytest.mark.parametrize("threads", [1, 2])
def test_normal_equations_and_step(sample: Sample, threads: int) -> None:
    problem, state = sample
    assert supports(problem)
    objective, reference = (
        CppSchurObjective(problem, state, CONFIG, threads=threads),
        SchurObjective(problem, state, CONFIG),
    )
    ours, expected = objective.linearize(state), reference.linearize(state)

    free = np.flatnonzero(reference.layout.free)
    hessian, gradient = ours.dense(ours.system)
    assert relative(hessian[np.ix_(free, free)], expected.hessian[np.ix_(free, free)]) < 1e-10
    assert relative(gradient[free], expected.gradient[free]) < 1e-10
    blocks, gradients = ours.landmark_blocks()
    for chunk, block in zip(reference.chunks, expected.blocks, strict=True):
        assert relative(blocks[chunk.landmarks], block.point_hessian) < 1e-10
        assert relative(gradients[chunk.landmarks], block.point_gradient) < 1e-10
    np.testing.assert_allclose(ours.gradient_max, expected.gradient_max, rtol=1e-10)

    reduced, expected_reduced = ours.reduced(DAMPING), expected.reduced(DAMPING)
    assert reduced is not None
    assert expected_reduced is not None
    matrix, right = ours.dense(reduced)
    assert relative(matrix[np.ix_(free, free)], expected_reduced[0][np.ix_(free, free)]) < 1e-10
    assert relative(right[free], expected_reduced[1][free]) < 1e-10

    for damping in (DAMPING, 10.0):
        step, expected_step = ours.solve(damping), expected.solve(damping)
        assert step is not None
        assert expected_step is not None
        assert set(step.delta) == set(expected_step.delta)
        for group, delta in expected_step.delta.items():
            assert relative(step.delta[group], delta) < 1e-8, group
        np.testing.assert_allclose(step.norm, expected_step.norm, rtol=1e-8)
        np.testing.assert_allclose(step.predicted_decrease, expected_step.predicted_decrease, rtol=1e-8)


def test_band_is_used_and_agrees_with_dense_storage(rng: np.random.Generator) -> None:
    problem, state = long_sequence(rng)
    objective = CppSchurObjective(problem, state, CONFIG)
    assert objective.columns.banded
    assert objective.columns.stored_rows == 35
    assert not CppSchurObjective(*scene(rng), CONFIG).columns.banded


@pytest.mark.parametrize("name", ["depth", "no depth", "repeated", "frozen landmarks", "camera terms", "long sequence"])
def test_solutions_agree(rng: np.random.Generator, name: str) -> None:
    problem, state = SAMPLES[name](rng)
    config = SolverConfig(relative_decrease=1e-13, max_iterations=300)
    ours, summary = minimize(CppSchurObjective(problem, state, config), state, config)
    expected, reference = minimize(SchurObjective(problem, state, config), state, config)
    np.testing.assert_allclose(summary.final_energy, reference.final_energy, rtol=1e-9)
    assert summary.converged
    for group in problem.free:
        assert relative(ours[group], expected[group]) < 1e-7, group


def test_frozen_variables_do_not_move(rng: np.random.Generator) -> None:
    problem, state = frozen(scene(rng), landmark=[2, 5], intrinsics=(0, [2, 3]), log_scale=[1], pose=[3])
    step = CppSchurObjective(problem, state, CONFIG).linearize(state).solve(DAMPING)
    assert step is not None
    for group, mask in problem.free.items():
        assert (step.delta[group][~mask] == 0.0).all()
        assert (step.delta[group][mask] != 0.0).all()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_same_bits_for_the_same_number_of_threads(rng: np.random.Generator, threads: int) -> None:
    problem, state = scene(rng, 20, 800)
    config = SolverConfig(max_iterations=4)
    first, second = (minimize(CppSchurObjective(problem, state, config, threads=threads), state, config) for _ in "ab")
    for group in problem.free:
        np.testing.assert_array_equal(first[0][group], second[0][group])
    assert first[1].final_energies == second[1].final_energies


def spoilt(sample: Sample, batch: int, name: str, row: int) -> Sample:
    array = sample[0].batches[batch].data[name].copy()
    array[row] = np.nan
    batches = list(sample[0].batches)
    batches[batch] = replace(batches[batch], data={name: array})
    return replace(sample[0], batches=tuple(batches)), sample[1]


@pytest.mark.parametrize(("batch", "name"), [(0, "uv"), (2, "depth")])
def test_values_that_are_not_finite_are_named(rng: np.random.Generator, batch: int, name: str) -> None:
    problem, state = spoilt(scene(rng, 6, 30), batch, name, 17)
    messages = []
    for objective in (CppSchurObjective(problem, state, CONFIG), SchurObjective(problem, state, CONFIG)):
        assert np.isnan(sum(objective.energies(state).values()))
        with pytest.raises(SolverError, match="landmark, track") as caught:
            objective.linearize(state)
        messages.append(str(caught.value))
    assert messages[0] == messages[1]


@pytest.mark.parametrize("group", ["pose", "intrinsics", "log_scale", "landmark"])
def test_a_state_that_is_not_finite_is_named(rng: np.random.Generator, group: str) -> None:
    problem, state = scene(rng, 6, 30)
    array = state[group].copy()
    array.reshape(len(array), -1)[-1, 0] = np.inf
    with pytest.raises(SolverError, match="is not finite"):
        CppSchurObjective(problem, state, CONFIG).linearize(state.replace(**{group: array}))


def test_undetermined_landmarks(rng: np.random.Generator) -> None:
    problem, state = depth_alone(rng)
    linearization = CppSchurObjective(problem, state, CONFIG).linearize(state)
    assert linearization.solve(0.0) is None
    message = CppSchurObjective(problem, state, CONFIG).diagnose(state)
    assert message == SchurObjective(problem, state, CONFIG).diagnose(state)
    assert "landmark, track 160" in message


def test_free_scale_is_diagnosed_like_numpy(rng: np.random.Generator) -> None:
    problem, state = scene(rng, depth=False)
    free = {g: np.ones_like(mask) for g, mask in problem.free.items()}
    problem = replace(problem, free=free)
    message = CppSchurObjective(problem, state, CONFIG).diagnose(state)
    assert message == SchurObjective(problem, state, CONFIG).diagnose(state)


def test_what_is_supported(rng: np.random.Generator) -> None:
    problem, state = scene(rng)
    assert supports(problem)
    assert not supports(problem, None)
    assert not supports(problem, "dynamic_point")
    with_landmark_prior, _ = bundle(rng)
    assert not supports(with_landmark_prior)
    assert not supports(replace(problem, free={g: m for g, m in problem.free.items() if g != "landmark"}))
    assert not supports(replace(problem, free={**problem.free, "dynamic_point": np.ones((2, 3), dtype=bool)}))
    assert not supports(replace(problem, free={**problem.free, "intrinsics": np.ones((2, 4), dtype=bool)}))
    reprojection, prior, depth, _ = problem.batches
    shared = reprojection.slots[2]
    two = replace(reprojection, slots=(*reprojection.slots[:2], replace(shared, rows=shared.rows + 1)))
    assert not supports(replace(problem, batches=(two, prior)))
    shifted = replace(depth, slots=(*depth.slots[:2], Slot("log_scale", (depth.slots[0].rows + 1) % 6)))
    assert not supports(replace(problem, batches=(reprojection, shifted)))
    with pytest.raises(SolverError, match="does not take this problem"):
        CppSchurObjective(with_landmark_prior, state, CONFIG)


def test_rows_out_of_range_are_refused(rng: np.random.Generator) -> None:
    problem, state = scene(rng)
    reprojection = problem.batches[0]
    rows = reprojection.slots[1].rows.copy()
    rows[3] = 1000
    wrong = replace(reprojection, slots=(reprojection.slots[0], Slot("landmark", rows), reprojection.slots[2]))
    with pytest.raises((SolverError, IndexError)):
        CppSchurObjective(replace(problem, batches=(wrong,)), state, CONFIG)
