"""Adam as a stage runner: what moves, where it ends, what it reports."""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from adam_samples import K, small_bundle

from uni4d_fg.config.adam import AdamConfig, AdamScheduleConfig
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import MissingDependencyError, SolverError
from uni4d_fg.factors import FactorBatch, Kernel, Slot
from uni4d_fg.factors.priors import log_scale_prior, scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.adam.runner import AdamRunner, reference_window, schedule_of
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem, all_free
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.optim.summary import Termination


def adam(iterations: int = 60, **options: Any) -> AdamRunner:
    schedule = AdamScheduleConfig(max_iterations=iterations)
    return AdamRunner(
        AdamConfig(
            camera_init=replace_iterations(AdamConfig().camera_init, iterations),
            bundle_adjustment=schedule,
            nonrigid=schedule,
            **options,
        )
    )


def changed(stage: Stage, **changes: Any) -> Stage:
    """Return the stage with other batches or other free entries."""
    return replace(stage, problem=replace(stage.problem, **changes))


def replace_iterations(schedule: AdamScheduleConfig, iterations: int) -> AdamScheduleConfig:
    return schedule.model_copy(update={"max_iterations": iterations})


@pytest.mark.parametrize("kernel", [Kernel("quadratic"), Kernel("huber", 1.3), Kernel("norm", 0.1)])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_energy_falls_and_is_scored_in_double_precision(
    kernel: Kernel, precision: str, rng: np.random.Generator
) -> None:
    stage, state = small_bundle(rng, kernel=kernel)
    solved, summary = adam(precision=precision)(stage, state)
    assert summary.final_energy < 0.5 * summary.initial_energy
    assert summary.initial_energies == stage.problem.energies(state)
    assert summary.final_energies == stage.problem.energies(solved)
    assert (summary.termination, len(summary.iterations)) == (Termination.MAX_ITERATIONS, 60)
    assert summary.notes["precision"] == precision
    assert summary.num_factors == 50
    assert all(array.dtype == np.float64 for array in solved.arrays.values())
    rotation = solved[POSE][:, :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)


def test_the_first_loss_is_the_energy_at_the_start(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    _, summary = adam(3, precision="float64")(stage, state)
    assert summary.iterations[0].energy == pytest.approx(summary.initial_energy, rel=1e-12)


def test_on_a_convex_problem_it_ends_where_levenberg_marquardt_does(rng: np.random.Generator) -> None:
    measured = rng.normal(scale=0.1, size=(40, 1))
    slot = Slot(LOG_SCALE, np.arange(40) % 8)
    batch = FactorBatch.create(log_scale_prior, (slot,), {"measured": measured}, sigma=0.1, kernel=Kernel("huber", 1.0))
    state = State({LOG_SCALE: np.zeros((8, 1))})
    stage = Stage("convex", Problem((batch,), all_free(state, LOG_SCALE)), SolverConfig(max_iterations=60))
    expected, by_lm = run_stage(stage, state)
    found, by_adam = adam(800, precision="float64")(stage, state)
    assert by_adam.final_energy == pytest.approx(by_lm.final_energy, rel=1e-4)
    np.testing.assert_allclose(found[LOG_SCALE], expected[LOG_SCALE], atol=2e-3)
    assert by_adam.termination is Termination.EARLY_STOPPED


def test_frozen_entries_keep_every_bit(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    free = {group: mask.copy() for group, mask in stage.problem.free.items()}
    free[POSE][2, :3] = False
    free[LANDMARK][4] = False
    free[LANDMARK][5, 1] = False
    solved, _ = adam(10)(changed(stage, free=free), state)
    np.testing.assert_array_equal(solved[POSE][0], state[POSE][0])
    np.testing.assert_array_equal(solved[POSE][2, :3, :3], state[POSE][2, :3, :3])
    assert (solved[POSE][2, :3, 3] != state[POSE][2, :3, 3]).all()
    np.testing.assert_array_equal(solved[INTRINSICS][0, 2:], K[2:])
    assert (solved[INTRINSICS][0, :2] != K[:2]).all()
    np.testing.assert_array_equal(solved[LANDMARK] != state[LANDMARK], free[LANDMARK])


def test_a_frozen_group_is_not_touched(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    solved, _ = adam(5)(changed(stage, free={LANDMARK: stage.problem.free[LANDMARK]}), state)
    for group in (POSE, INTRINSICS):
        assert solved[group] is state[group]


def test_half_a_rotation_cannot_be_free(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    free = {group: mask.copy() for group, mask in stage.problem.free.items()}
    free[POSE][1, 0] = False
    with pytest.raises(SolverError, match="as a whole"):
        adam(5)(changed(stage, free=free), state)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_two_solves_agree_bit_by_bit(precision: str, rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    (first, one), (second, two) = (adam(20, precision=precision)(stage, state) for _ in range(2))
    for group, array in first.arrays.items():
        np.testing.assert_array_equal(array, second[group])
    assert [record.energy for record in one.iterations] == [record.energy for record in two.iterations]


def test_keep_best_ends_at_the_lowest_loss(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    wild = AdamScheduleConfig(max_iterations=25, point_learning_rate=0.3, pose_learning_rate=0.3)
    ends = {}
    for keep_best in (False, True):
        config = AdamConfig(bundle_adjustment=wild, keep_best=keep_best, precision="float64")
        _, summary = AdamRunner(config)(stage, state)
        ends[keep_best] = summary.final_energy
        lowest = min(record.energy for record in summary.iterations)
    assert ends[True] == pytest.approx(lowest, rel=1e-12)
    assert ends[True] < ends[False]


def test_the_scale_anchor_is_left_out_unless_asked_for(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    slots = (Slot(POSE, np.zeros(1, dtype=np.int64)), Slot(POSE, np.array([3])))
    anchor = FactorBatch.create(scale_anchor, slots, {"distance": np.array([0.5])}, sigma=1e-3)
    stage = changed(stage, batches=(*stage.problem.batches, anchor))
    assert "scale_anchor" not in adam(2)(stage, state)[1].final_energies
    assert "scale_anchor" in adam(2, scale_anchor=True)(stage, state)[1].final_energies


def test_a_window_of_the_reference_floats_and_starts_at_the_pose_before(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng, kind="camera_init")
    keep = np.flatnonzero(stage.problem.batches[0].slots[0].rows > 0)
    free = {**stage.problem.free, POSE: stage.problem.free[POSE].copy()}
    free[POSE][1] = False
    stage = changed(stage, batches=(stage.problem.batches[0].take(keep), stage.problem.batches[1]), free=free)
    floating, start = reference_window(stage, state)
    assert floating.problem.free[POSE].all(axis=1).tolist() == [False, True, True, True]
    np.testing.assert_array_equal(start[POSE][3], state[POSE][2])
    floated, _ = adam(5)(stage, state)
    held, _ = adam(5, reference_windows=False)(stage, state)
    assert (floated[POSE][1] != state[POSE][1]).any()
    np.testing.assert_array_equal(held[POSE][1], state[POSE][1])
    assert not free[POSE][1].any()


def test_every_stage_has_its_schedule() -> None:
    config = AdamConfig()
    assert schedule_of("camera_init", config) is config.camera_init
    assert schedule_of("nonrigid", config) is config.nonrigid
    for kind in ("bundle_adjustment", "structure", "another"):
        assert schedule_of(kind, config) is config.bundle_adjustment


def test_without_free_variables_nothing_is_done(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    solved, summary = adam()(changed(stage, free={}), state)
    assert solved is state
    assert summary.termination is Termination.NOTHING_TO_DO


def test_a_cancelled_solve_says_so(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    solved, summary = adam()(stage, state, Hooks(should_stop=lambda: True))
    assert (summary.termination, summary.iterations) == (Termination.CANCELLED, ())
    np.testing.assert_array_equal(solved[POSE][0], state[POSE][0])


def test_a_cue_that_is_not_finite_is_named(rng: np.random.Generator) -> None:
    stage, state = small_bundle(rng)
    stage.problem.batches[0].data["uv"][13] = np.nan
    with pytest.raises(SolverError, match=r"static_reprojection: .*camera pose, frame 1 and landmark, track 3"):
        adam()(stage, state)


def test_a_missing_torch_is_one_clear_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.import_module

    def without_torch(name: str, package: str | None = None) -> Any:
        if name == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without_torch)
    with pytest.raises(
        MissingDependencyError, match=r"^the Adam solver needs torch, .*: run `pip install .*\[adam\]'`$"
    ):
        AdamRunner()


def test_a_missing_gpu_is_refused_and_auto_takes_what_is_there() -> None:
    import torch

    if torch.cuda.is_available():
        assert AdamRunner(AdamConfig(device="auto")).device == "cuda"
        return
    with pytest.raises(SolverError, match=r"adam\.device"):
        AdamRunner(AdamConfig(device="cuda"))
    assert AdamRunner(AdamConfig(device="auto")).device == "cpu"
