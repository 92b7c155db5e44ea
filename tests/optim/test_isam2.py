"""ISAM2 on a problem that grows, changes and shrinks ends where a solve of the whole does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solve_samples import bundle

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.optim.backend import Backend
from uni4d_fg.optim.isam2 import Isam2Runner
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import LevenbergMarquardtRunner, Stage
from uni4d_fg.optim.summary import SolveSummary

WHOLE = LevenbergMarquardtRunner(Backend("python"))
CONFIG = SolverConfig(max_iterations=30, relative_decrease=1e-9)


def up_to(problem: Problem, frame: int) -> Problem:
    """Keep the factors of frames up to ``frame``."""
    batches = []
    for batch in problem.batches:
        rows = [slot.rows for slot in batch.slots if slot.variable is POSE or slot.variable.name == "log_scale"]
        batches.append(batch.take(np.flatnonzero(np.max(rows, axis=0) <= frame)) if rows else batch)
    return replace(problem, batches=tuple(batches))


def solve_both(runner: Isam2Runner, problem: Problem, state: State) -> tuple[State, SolveSummary]:
    stage = Stage("bundle_adjustment", problem, CONFIG)
    found, summary = runner(stage, state)
    _, expected = WHOLE(stage, state)
    assert summary.final_energy == pytest.approx(expected.final_energy, rel=1e-5)
    assert problem.energies(found) == pytest.approx(summary.final_energies)
    return found, summary


@pytest.fixture
def made(rng: np.random.Generator) -> tuple[Problem, State]:
    problem, state = bundle(rng, num_poses=6, num_landmarks=15, kernel=Kernel("huber", 1.5), depth=True)
    return problem.fix(POSE, rows=[0]), state


def test_a_growing_problem(made: tuple[Problem, State]) -> None:
    problem, state = made
    held = replace(problem, free=dict(problem.free)).fix(INTRINSICS)
    runner, counts = Isam2Runner(1e-6), []
    for frame in (2, 3, 4):
        part = up_to(held, frame)
        state, summary = solve_both(runner, part, state)
        counts.append(summary.num_factors)
        np.testing.assert_array_equal(state[INTRINSICS], held_start(made))
    assert np.diff(counts).min() > 10
    state, summary = solve_both(runner, problem, state)  # the last frame, and the intrinsics are free
    assert np.abs(state[INTRINSICS] - held_start(made)).max() > 1.0
    assert "rebuilt" not in summary.notes
    (part_solved,) = summary.notes["solved_by"]
    assert part_solved["by"] == "GTSAM ISAM2"


def held_start(made: tuple[Problem, State]) -> np.ndarray:
    return np.asarray(made[1][INTRINSICS])


def test_factors_that_go_or_change(made: tuple[Problem, State]) -> None:
    problem, state = made
    runner = Isam2Runner(1e-6)
    state, first = solve_both(runner, problem, state)
    # A landmark is forgotten with all its factors, and one observation of another.
    reprojection = problem.batches[0]
    keep = (reprojection.slots[1].rows != 3) & (np.arange(len(reprojection)) != 40)
    batches = [batch.take(np.flatnonzero(batch.slots[1].rows != 3)) if len(batch.slots) > 1 else batch
               for batch in problem.batches[1:]]  # fmt: skip
    batches[0] = batches[0].take(np.flatnonzero(batches[0].slots[0].rows != 3))
    smaller = replace(problem, batches=(reprojection.take(np.flatnonzero(keep)), *batches))
    state, second = solve_both(runner, smaller, state)
    assert not runner.tree.valueExists(LANDMARK.key(10 + 3 * 3))
    assert second.num_variables == first.num_variables - 1
    # Measured noise that changes much replaces its factors; a little does not.
    for factor, replaced in ((1.05, False), (2.0, True)):
        before = {known.index for known in runner._in_tree.values()}
        wider = replace(smaller.batches[0], sigma=factor * smaller.batches[0].sigma)
        state, _ = runner(
            Stage("bundle_adjustment", replace(smaller, batches=(wider, *smaller.batches[1:])), CONFIG), state
        )
        new = {known.index for known in runner._in_tree.values()} - before
        assert len(new) == (len(wider) if replaced else 0)
    # The landmark comes back.
    solve_both(runner, problem, state)


def test_a_singular_system_is_named(made: tuple[Problem, State]) -> None:
    problem, state = made
    alone = Problem((problem.batches[0].take(np.arange(1)),), problem.free)
    with pytest.raises(SolverError, match=r"GTSAM ISAM2 failed: .* near variable \w+[ \w]*, \w+ \d"):
        Isam2Runner()(Stage("bundle_adjustment", alone, CONFIG), state)
