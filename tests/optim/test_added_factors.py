"""Factors that sources add to a stage, and terms that they replace."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.priors import log_scale_deviation, log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import CUE_SCALE, LOG_SCALE
from uni4d_fg.optim.added_factors import HOLDS_SCALE, AddingRunner, Addition, adding_to, checked_sources, joined_by
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, run_stage

SCALES = np.array([[0.5], [0.7], [0.6]])


def stage() -> tuple[Stage, State]:
    state = State({LOG_SCALE: np.zeros((3, 1))})
    problem = Problem.over(state)
    problem.add(log_scale_prior([0, 1, 2], measured=np.zeros((3, 1)), sigma=0.01))
    return Stage("structure", problem, SolverConfig(relative_decrease=1e-12)), state


def observed(frames: int = 3) -> list[object]:
    """What something else says of the scales, by a term of the same type as the stage's own."""
    return [log_scale_prior(list(range(frames)), measured=SCALES[:frames], sigma=0.1)]


def test_a_replaced_term_is_gone_and_what_replaces_it_is_not() -> None:
    declared, state = stage()

    def source(_: Stage, now: State) -> Addition:
        common = log_scale_deviation([0, 1, 2], 0, sigma=0.05)
        pull = log_scale_deviation([0], 0, sigma=1e3)
        return Addition([common, pull], {CUE_SCALE: np.full((1, 1), 0.6)}, replaces=[log_scale_prior])

    runner = AddingRunner(run_stage, [source])
    solved, summary = runner(declared, state)
    assert set(summary.final_energies) == {"log_scale_deviation"}
    np.testing.assert_allclose(solved[LOG_SCALE], runner.known.of(CUE_SCALE)[(0,)][0], atol=1e-6)
    assert CUE_SCALE not in solved
    assert summary.notes[HOLDS_SCALE]
    assert set(declared.problem.energies(state)) == {"log_scale_prior"}  # the stage itself is as it was


def test_replacing_spares_what_sources_add() -> None:
    declared, state = stage()
    runner = AddingRunner(run_stage, [lambda _, __: Addition(observed(), replaces=[log_scale_prior])])
    solved, _ = runner(declared, state)
    np.testing.assert_allclose(solved[LOG_SCALE], SCALES, atol=1e-8)


def test_without_replacement_both_count() -> None:
    declared, state = stage()
    solved, _ = AddingRunner(run_stage, [lambda _, __: Addition(observed(), is_metric=False)])(declared, state)
    assert np.abs(solved[LOG_SCALE]).max() == pytest.approx(0.7 / 101.0, rel=1e-3)


def test_a_stage_as_it_was_solved_has_what_every_source_added() -> None:
    declared, state = stage()

    def common(_: Stage, now: State) -> Addition:
        factors = [log_scale_deviation([0, 1, 2], 0, sigma=0.05)]
        return Addition(factors, {CUE_SCALE: np.zeros((1, 1))}, replaces=[log_scale_prior])

    inner = AddingRunner(run_stage, [lambda _, __: Addition(observed(), is_metric=False)])
    runner = adding_to(inner, [common])
    solved, _ = runner(declared, state)
    whole = joined_by(runner, declared, solved)
    assert {batch.name for batch in whole.stage.problem.batches} == {"log_scale_deviation", "log_scale_prior"}
    np.testing.assert_allclose(whole.state[CUE_SCALE], 0.6, atol=1e-6)
    np.testing.assert_allclose(whole.state[LOG_SCALE], solved[LOG_SCALE])
    alone = joined_by(run_stage, declared, state)
    assert (alone.stage, alone.state) == (declared, state)


@pytest.mark.parametrize(
    ("index", "said"),
    [
        (
            {},
            r"^log_scale_prior reads row 3 of log_scale \(depth log-scale, frame 3\), .*; give rows below 3$",
        ),
        (
            {LOG_SCALE: np.array([10, 11, 12])},
            "^log_scale_prior reads row 3 of log_scale, which the problem",
        ),
    ],
)
def test_a_factor_on_frames_that_are_not_there_is_named(index: dict[Any, Any], said: str) -> None:
    declared, state = stage()
    added = log_scale_prior(np.arange(5), measured=np.zeros((5, 1)), sigma=0.1)
    with pytest.raises(SolverError, match=said):
        AddingRunner(run_stage, [lambda _, __: Addition([added])])(declared, State(state.arrays, index))


def test_a_factor_on_variables_that_are_not_there_is_named() -> None:
    declared, state = stage()
    added = log_scale_deviation([0], 0, sigma=0.1)
    with pytest.raises(SolverError, match="log_scale_deviation: the state has no cue_scale variables"):
        AddingRunner(run_stage, [lambda _, __: Addition([added], is_metric=False)])(declared, state)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (5, "structure: the source positions returned int, but an Addition or None is expected"),
        (observed(), "positions returned list"),
        (Addition([5]), "a batch of factors or a factor of GTSAM's is expected, got int"),
        (Addition("prior"), "a batch of factors or a factor of GTSAM's is expected, got str"),
    ],
)
def test_what_a_source_returns_must_be_an_addition_of_factors(found: Any, said: str) -> None:
    declared, state = stage()

    def positions(_: Stage, __: State) -> Any:
        return found

    with pytest.raises(SolverError, match=said):
        AddingRunner(run_stage, [positions])(declared, state)


def test_additions_are_a_list_of_functions() -> None:
    def positions(_: Stage, __: State) -> None:
        return None

    assert checked_sources(source for source in [positions]) == (positions,)
    wrong: list[tuple[Any, str]] = [
        (positions, r"not one alone; give \[positions\]"),
        (5, "a list of sources is expected, got int"),
        (None, "a list of sources is expected, got NoneType"),
        (["x"], "a source is a function of stage and state .*, got str"),
        ([Addition([])], "got Addition"),
    ]
    for additions, said in wrong:
        with pytest.raises(SolverError, match=f"^additions: .*{said}"):
            checked_sources(additions)


def test_the_kernel_of_a_factor_is_no_name() -> None:
    with pytest.raises(SolverError, match=r"log_scale_prior: kernel must be a Kernel such as .*, got 'huber'"):
        log_scale_prior([0], measured=np.zeros((1, 1)), kernel="huber")  # type: ignore[arg-type]
