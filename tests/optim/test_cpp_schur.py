"""The C++ landmark system against the NumPy one: energies, normal equations, steps, solutions, messages."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from solve_samples import LANDMARK_PRIOR, POINT_PRIOR, Sample, bundle, pair_terms, through_a_lens, zooming

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorBatch, FactorType, Kernel, Slot, VariableType
from uni4d_fg.factors.camera_motion import camera_rotation, camera_translation, relative_camera_translation
from uni4d_fg.factors.depth_prior import static_depth_prior
from uni4d_fg.factors.lens_reprojection import fisheye_reprojection, opencv_reprojection
from uni4d_fg.factors.priors import intrinsics_prior, log_scale_prior, scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable_types import DYNAMIC_POINT, INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.backend import Backend, make_objective
from uni4d_fg.optim.block import BlockObjective
from uni4d_fg.optim.levenberg_marquardt import minimize
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.schur import SchurObjective

pytest.importorskip("uni4d_fg_cpp")

from uni4d_fg.optim.cpp_schur import CppSchurObjective, refusal

CONFIG = SolverConfig(min_diagonal=1e-9)
TIE = FactorType(
    "tie", (LANDMARK, DYNAMIC_POINT), {}, 3, lambda landmark, point: point - landmark,
    lambda landmark, point: (point - landmark, [-identity(len(point)), identity(len(point))]), listed=False,
)  # fmt: skip
DAMPING = 1e-3


def identity(count: int) -> np.ndarray:
    return np.broadcast_to(np.eye(3), (count, 3, 3))


def scene(rng: np.random.Generator, num_poses: int = 6, num_landmarks: int = 90, **options: object) -> Sample:
    """A bundle adjustment whose gauge is held by its first pose, and by its last where there is no depth."""
    options = {"kernel": Kernel("huber", 1.0), "outliers": 12, "depth": True, **options}
    problem, state = bundle(rng, num_poses, num_landmarks, **options)  # type: ignore[arg-type]
    free = {g: mask.copy() for g, mask in problem.free.items()}
    free[POSE][0] = False
    if not options["depth"]:
        free[POSE][-1] = False
    return Problem(tuple(b for b in problem.batches if b.name != "landmark_prior"), free, LANDMARK), state


def changed(sample: Sample, change: Callable[[FactorBatch], FactorBatch]) -> Sample:
    return replace(sample[0], batches=tuple(change(b) for b in sample[0].batches)), sample[1]


def frozen(sample: Sample, **masks: object) -> Sample:
    """Freeze the given rows, or (rows, columns), of groups; everything for None."""
    free = {g: mask.copy() for g, mask in sample[0].free.items()}
    for group, mask in free.items():
        if group.name in masks:
            where = masks.pop(group.name)
            mask[where if where is not None else slice(None)] = False
    assert not masks
    return replace(sample[0], free=free), sample[1]


def per_row_noise(rng: np.random.Generator) -> Sample:
    def change(batch: FactorBatch) -> FactorBatch:
        n, d = len(batch), batch.factor_type.dim
        shape = (n, d) if batch.factor_type == static_reprojection else (n,)
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
    landmarks = state[LANDMARK].copy()
    landmarks[::7, 2] -= 6.0
    landmarks[3, 2] = 0.02
    return problem, state.replace({LANDMARK: landmarks})


def some_without_depth(rng: np.random.Generator) -> Sample:
    return changed(scene(rng), lambda b: b.take(np.arange(0, len(b), 3)) if b.factor_type == static_depth_prior else b)


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
    tie = FactorBatch.create(TIE, (Slot(LANDMARK, np.zeros(1, int)), Slot(DYNAMIC_POINT, np.zeros(1, int))))
    empty = tuple(
        replace(b.take(np.zeros(0, dtype=np.int64)), term=f"empty {i}") for i, b in enumerate((*problem.batches, tie))
    )
    return replace(problem, batches=(*empty, *problem.batches)), state


def camera_terms(rng: np.random.Generator) -> Sample:
    """Terms on two and three poses besides those on landmarks, one reading a pose twice."""
    problem, state = scene(rng)
    n = len(state[POSE])
    three = tuple(Slot(POSE, np.arange(i, n - 2 + i)) for i in range(3))
    floor = {"floor": np.full(n - 2, 0.01)}
    ends = (Slot(POSE, np.array([1])), Slot(POSE, np.array([n - 1])))
    return replace(
        problem,
        batches=(
            *problem.batches,
            FactorBatch.create(camera_rotation, three, floor, sigma=0.1),
            FactorBatch.create(camera_translation, three, floor, sigma=0.1, kernel=Kernel("huber", 1.0)),
            FactorBatch.create(relative_camera_translation, three, floor, sigma=0.2, kernel=Kernel("norm", 0.01)),
            FactorBatch.create(scale_anchor, ends, {"distance": np.array([0.5])}, sigma=1e-2),
            pair_terms(rng, n, 40, True),
        ),
    ), state


def long_sequence(rng: np.random.Generator) -> Sample:
    """Short tracks along many frames: the camera system is stored as a band."""
    problem, state = scene(rng, 40, 300)
    first = rng.integers(-4, 40, 300)
    in_front = problem.batches[2].data["depth"] > 0.5

    def near(batch: FactorBatch) -> FactorBatch:
        if batch.factor_type not in (static_reprojection, static_depth_prior):
            return batch
        away = batch.slots[0].rows - first[batch.slots[1].rows]
        return batch.take(np.flatnonzero((away >= 0) & (away < 5) & in_front))

    return changed((problem, state), near)


def landmark_prior(rng: np.random.Generator) -> Sample:
    """A prior on every landmark, which C++ does not know; nothing else holds the gauge."""
    problem, state = bundle(rng, 6, 90, kernel=Kernel("huber", 1.0), outliers=12, depth=True)
    return problem.eliminate(LANDMARK), state


def two_cameras(rng: np.random.Generator) -> Sample:
    """Every third observation by a second camera, with the intrinsics of both held."""
    problem, state = frozen(scene(rng), intrinsics=None)
    reprojection = problem.batches[0]
    camera = Slot(INTRINSICS, np.arange(len(reprojection)) % 3 // 2)
    two = replace(reprojection, slots=(*reprojection.slots[:2], camera))
    state = state.replace({INTRINSICS: np.concatenate([state[INTRINSICS], 1.1 * state[INTRINSICS]])})
    free = {g: mask for g, mask in problem.free.items() if g is not INTRINSICS}
    batches = (two, *(b for b in problem.batches[1:] if b.factor_type is not intrinsics_prior))
    return replace(problem, batches=batches, free=free), state


def scales_of_other_frames(rng: np.random.Generator) -> Sample:
    """Depth priors that read the scale of the frame after theirs."""
    problem, state = scene(rng)
    reprojection, prior, depth, scales = problem.batches
    shifted = replace(depth, slots=(*depth.slots[:2], Slot(LOG_SCALE, (depth.slots[0].rows + 1) % 6)))
    return replace(problem, batches=(reprojection, prior, shifted, scales)), state


def moving_points(rng: np.random.Generator) -> Sample:
    """Points of another type in the same problem, tied to landmarks and to a prior."""
    problem, state = scene(rng)
    points = state[LANDMARK][:4] + rng.normal(scale=0.1, size=(4, 3))
    state = State({**state.arrays, DYNAMIC_POINT: points}, state.index)
    rows = np.arange(4)
    tie = FactorBatch.create(TIE, (Slot(LANDMARK, rows), Slot(DYNAMIC_POINT, rows)), sigma=0.1)
    prior = FactorBatch.create(POINT_PRIOR, (Slot(DYNAMIC_POINT, rows),), {"measured": points + 0.05}, sigma=0.2)
    free = {**problem.free, DYNAMIC_POINT: np.ones((4, 3), dtype=bool)}
    free[DYNAMIC_POINT][2, 1] = False
    return replace(problem, batches=(*problem.batches, tie, prior), free=free), state


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
    "landmark prior": landmark_prior,
    "two cameras": two_cameras,
    "scales of other frames": scales_of_other_frames,
    "moving points": moving_points,
    "polynomial lens": lambda rng: through_a_lens(scene(rng), opencv_reprojection),
    "fisheye": lambda rng: through_a_lens(scene(rng, 9, 300), fisheye_reprojection),
    "lens in a long sequence": lambda rng: through_a_lens(long_sequence(rng), opencv_reprojection),
    "lens and frozen entries": lambda rng: frozen(
        through_a_lens(scene(rng), opencv_reprojection),
        pose=(slice(2, 4), slice(1, 5)),
        log_scale=[1, 2],
        landmark=slice(0, 90, 4),
    ),
    "zoom": lambda rng: zooming(scene(rng, depth=False)),
    "zoom in a long sequence": lambda rng: zooming(long_sequence(rng), with_depth=False),
    "zoom and log-scales": lambda rng: zooming(scene(rng)),
    "zoom and frozen entries": lambda rng: frozen(
        zooming(scene(rng, depth=False)), pose=(slice(2, 4), slice(1, 5)), zoom=[3], landmark=slice(0, 90, 4)
    ),
    "frozen landmarks": lambda rng: frozen(scene(rng), landmark=slice(0, 90, 4)),
    "frozen intrinsics": lambda rng: frozen(scene(rng), intrinsics=None),
    "frozen center": lambda rng: frozen(scene(rng), intrinsics=(slice(None), slice(2, 4))),
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


def test_a_zoom_is_no_border_where_no_log_scale_stands(rng: np.random.Generator) -> None:
    alone = CppSchurObjective(*zooming(long_sequence(rng), with_depth=False), CONFIG).columns
    assert (alone.border, alone.size, alone.banded) == (4, 7 * 39, True)
    beside = CppSchurObjective(*zooming(long_sequence(rng)), CONFIG).columns
    assert (beside.border, beside.size) == (4 + 39, 6 * 39 + 40)


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
    assert refusal(problem) == ""
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


AGREE = (
    "depth", "no depth", "repeated", "frozen landmarks", "camera terms", "long sequence", "landmark prior",
    "two cameras", "scales of other frames", "moving points", "polynomial lens",
)  # fmt: skip


@pytest.mark.parametrize("name", AGREE)
def test_solutions_agree(rng: np.random.Generator, name: str) -> None:
    problem, state = SAMPLES[name](rng)
    config = SolverConfig(relative_decrease=1e-13, max_iterations=300)
    ours, summary = minimize(CppSchurObjective(problem, state, config), state, config)
    expected, reference = minimize(SchurObjective(problem, state, config), state, config)
    np.testing.assert_allclose(summary.final_energy, reference.final_energy, rtol=1e-9)
    assert summary.converged
    for group in problem.free:
        # Where the energy no longer falls, the weakest directions of a long sequence are still open by 3e-7 or less, as
        # the rounding of the processor has it.
        assert relative(ours[group], expected[group]) < 1e-6, group


def test_frozen_variables_do_not_move(rng: np.random.Generator) -> None:
    problem, state = frozen(scene(rng), landmark=[2, 5], intrinsics=(0, [2, 3]), log_scale=[1], pose=[3])
    step = CppSchurObjective(problem, state, CONFIG).linearize(state).solve(DAMPING)
    assert step is not None
    for group, mask in problem.free.items():
        assert (step.delta[group][~mask] == 0.0).all()
        assert (step.delta[group][mask] != 0.0).all()


def test_same_bits_for_any_number_of_threads(rng: np.random.Generator) -> None:
    problem, state = scene(rng, 20, 1600)  # some 30,000 records: enough for all parts of a plan
    config = SolverConfig(max_iterations=4)
    expected, told = minimize(CppSchurObjective(problem, state, config, threads=1), state, config)
    for threads in (1, 2, 3, 16):
        solved, summary = minimize(CppSchurObjective(problem, state, config, threads=threads), state, config)
        for group in problem.free:
            np.testing.assert_array_equal(solved[group], expected[group])
        assert summary.final_energies == told.final_energies


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


@pytest.mark.parametrize("group", [POSE, INTRINSICS, LOG_SCALE, LANDMARK], ids=lambda v: v.name)
def test_a_state_that_is_not_finite_is_named(rng: np.random.Generator, group: VariableType) -> None:
    problem, state = scene(rng, 6, 30)
    array = state[group].copy()
    array.reshape(len(array), -1)[-1, 0] = np.inf
    with pytest.raises(SolverError, match="is not finite"):
        CppSchurObjective(problem, state, CONFIG).linearize(state.replace({group: array}))


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


def test_what_is_taken(rng: np.random.Generator) -> None:
    problem, state = scene(rng)
    assert refusal(problem) == ""
    for other in (None, DYNAMIC_POINT):
        assert refusal(replace(problem, eliminated=other)) == "no landmarks are eliminated"
    held = replace(problem, free={g: m for g, m in problem.free.items() if g is not LANDMARK})
    assert refusal(held) == "no landmarks are eliminated"
    several = replace(problem, free={**problem.free, INTRINSICS: np.ones((2, 4), dtype=bool)})
    assert refusal(several) == "the C++ landmark solver takes the intrinsics of one camera"
    pairs = FactorBatch.create(
        FactorType("pair", (LANDMARK, LANDMARK), {}, 3, TIE.residual, TIE.linearize, listed=False),
        (Slot(LANDMARK, np.arange(3)), Slot(LANDMARK, np.arange(3) + 1)),
    )
    in_part = frozen((problem, state), landmark=(slice(4, 6), 2))[0]
    assert refusal(in_part) == "some entries of a landmark are frozen and others are not"
    on_two = replace(problem, batches=(*problem.batches, pairs))
    assert refusal(on_two) == "pair reads two landmarks"
    for refused in (held, several, in_part, on_two):
        with pytest.raises(SolverError, match=re.escape(f"does not take this problem: {refusal(refused)}")):
            CppSchurObjective(refused, state, CONFIG)
    left = State({v: array for v, array in state.arrays.items() if v is not POSE}, state.index)
    assert refusal(problem, left) == "the C++ landmark solver needs poses"
    more = state.replace({LOG_SCALE: np.zeros((7, 1))})
    assert refusal(problem, state) == ""
    assert refusal(problem, more) == "the C++ landmark solver needs one log-scale per frame"


def test_a_landmark_that_is_frozen_in_part_keeps_those_entries(rng: np.random.Generator) -> None:
    problem, state = frozen(scene(rng), landmark=(slice(4, 6), 2))
    config = SolverConfig(relative_decrease=1e-13, max_iterations=300)
    reason = "some entries of a landmark variable are frozen and others are not"
    with pytest.raises(SolverError, match=reason):
        SchurObjective(problem, state, config)
    planned = make_objective(Backend("cpp"), problem, state, config)
    assert type(planned.objective) is BlockObjective
    assert planned.why == reason
    solved, summary = minimize(planned.objective, state, config)
    assert summary.converged
    moved = solved[LANDMARK] != state[LANDMARK]
    np.testing.assert_array_equal(moved, problem.free[LANDMARK])


def test_without_poses_the_fallback_solves(rng: np.random.Generator) -> None:
    points, scales = rng.normal(size=(5, 3)), np.zeros((5, 1))
    height = FactorType(
        "height", (LANDMARK, LOG_SCALE), {"measured": (1,)}, 1,
        lambda landmark, log_scale, *, measured: landmark[:, 1:2] - log_scale - measured, listed=False,
    )  # fmt: skip
    rows = np.arange(5)
    batches = (
        FactorBatch.create(height, (Slot(LANDMARK, rows), Slot(LOG_SCALE, rows)), {"measured": np.ones((5, 1))}),
        FactorBatch.create(LANDMARK_PRIOR, (Slot(LANDMARK, rows),), {"measured": points}, sigma=0.5),
        FactorBatch.create(log_scale_prior, (Slot(LOG_SCALE, rows),), {"measured": scales}, sigma=0.1),
    )
    state = State({LANDMARK: points, LOG_SCALE: scales})
    problem = Problem(batches, all_free(state, LANDMARK, LOG_SCALE), LANDMARK)
    config = SolverConfig(relative_decrease=1e-13, max_iterations=300)
    planned = make_objective(Backend("cpp"), problem, state, config)
    assert type(planned.objective) is SchurObjective
    assert planned.why == "the C++ landmark solver needs poses"
    solved, _ = minimize(planned.objective, state, config)
    # Of the residual's variance of 1 + 0.5^2 + 0.1^2 every part takes its share.
    pull = (1.0 - points[:, 1]) / (1.0 + 0.25 + 0.01)
    np.testing.assert_allclose(solved[LANDMARK][:, 1], points[:, 1] + 0.25 * pull, atol=1e-7)
    np.testing.assert_allclose(solved[LOG_SCALE][:, 0], -0.01 * pull, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "compiled", "linearized"),
    [
        ("depth", ("static_reprojection", "depth_prior"), ()),
        ("landmark prior", ("static_reprojection", "depth_prior"), ("landmark_prior",)),
        ("two cameras", ("depth_prior",), ("static_reprojection",)),
        ("scales of other frames", ("static_reprojection",), ("depth_prior",)),
        ("moving points", ("static_reprojection", "depth_prior"), ("tie",)),
        ("fisheye", ("depth_prior",), ("static_reprojection",)),
    ],
)
def test_what_it_does_not_know_takes_part_linearized(
    rng: np.random.Generator, name: str, compiled: tuple[str, ...], linearized: tuple[str, ...]
) -> None:
    own, cameras, foreign = CppSchurObjective(*SAMPLES[name](rng), CONFIG).parts()
    assert (own.by, own.terms) == ("C++ landmark elimination", compiled)
    assert (foreign.by, foreign.terms) == ("linearized blocks in the C++ landmark elimination", linearized)
    assert "log_scale_prior" in cameras.terms


def test_rows_out_of_range_are_refused(rng: np.random.Generator) -> None:
    problem, state = scene(rng)
    reprojection = problem.batches[0]
    rows = reprojection.slots[1].rows.copy()
    rows[3] = 1000
    wrong = replace(reprojection, slots=(reprojection.slots[0], Slot(LANDMARK, rows), reprojection.slots[2]))
    with pytest.raises((SolverError, IndexError)):
        CppSchurObjective(replace(problem, batches=(wrong,)), state, CONFIG)
