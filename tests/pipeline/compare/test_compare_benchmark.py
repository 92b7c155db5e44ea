from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import pytest

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import Cancelled
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.priors import intrinsics_prior, scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, POSE
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.pipeline.compare.benchmark import Benchmark, run_benchmark
from uni4d_fg.pipeline.compare.memory import PeakMemory
from uni4d_fg.pipeline.compare.task import Task, TaskRecorder
from uni4d_fg.pipeline.compare.trace import trace_solve

TICK = 0.02


def pull(target: float, kernel: Kernel | None = None) -> Task:
    """One 4-vector at zero, pulled towards (target, 0, 0, 0)."""
    state = State({INTRINSICS: np.zeros((1, 4))})
    measured = np.array([[target, 0.0, 0.0, 0.0]])
    problem = Problem.over(state).add(intrinsics_prior(0, measured=measured, kernel=kernel or Kernel("norm", 1e-3)))
    return Task(Stage("pull", problem, SolverConfig(), part="0-1"), state)


def walker(steps: list[float]) -> StageRunner:
    """A solver that moves the first entry to the given values, one per tick."""

    def run(stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        hooks, began = hooks or Hooks(), time.perf_counter()
        for value in steps:
            if hooks.should_stop is not None and hooks.should_stop():
                break
            time.sleep(TICK)
            state = state.replace({INTRINSICS: np.array([[value, 0.0, 0.0, 0.0]])})
            if hooks.on_state is not None:
                hooks.on_state(state)
        total = {"total": time.perf_counter() - began}
        return state, SolveSummary(stage.name, Termination.STEP, {}, {}, (), total)

    return run


def benchmark(solvers: dict[str, StageRunner], tasks: list[Task], repeats: int = 2) -> Benchmark:
    return run_benchmark("pull", "common", tasks, solvers, repeats=repeats, budget_seconds=60.0)


def test_a_trace_scores_every_state_and_its_time() -> None:
    trace = trace_solve(walker([3.0, 8.0, 9.0]), pull(10.0))
    assert trace.energies[:4] == pytest.approx([10.0, 7.0, 2.0, 1.0])
    assert trace.energy == pytest.approx(1.0)
    assert trace.final == {"intrinsics_prior": pytest.approx(1.0)}
    assert (np.diff(trace.seconds[:4]) >= TICK).all()
    assert trace.time_to_reach(2.0) == trace.seconds[2]
    assert trace.time_to_reach(10.0) == 0.0
    assert math.isinf(trace.time_to_reach(0.5))


def test_the_time_of_a_state_includes_the_set_up() -> None:
    def slow_start(stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        time.sleep(5 * TICK)
        return walker([9.0])(stage, state, hooks)

    assert trace_solve(slow_start, pull(10.0)).seconds[1] >= 6 * TICK


def test_levenberg_marquardt_leaves_a_falling_trace_that_ends_at_its_state() -> None:
    task = pull(10.0, Kernel("huber", 1.0))
    solved, summary = run_stage(task.stage, task.start)
    trace = trace_solve(run_stage, task)
    assert len(trace.seconds) == len(summary.iterations) + 2
    assert (np.diff(trace.energies) <= 0).all()
    assert trace.energy == pytest.approx(sum(task.score(solved).values()), abs=1e-12)


def test_the_scale_anchor_is_not_scored() -> None:
    state = State({POSE: np.tile(np.eye(4), (2, 1, 1))})
    problem = Problem.over(state).add(scale_anchor(0, 1, distance=np.array([5.0]), sigma=1e-3))
    stage = Stage("anchored", problem, SolverConfig())
    assert Task(stage, state).score(state) == {}
    assert sum(stage.problem.energies(state).values()) > 1e6


def test_ratios_of_times_and_energies() -> None:
    quick, slow = walker([10.0 - 1e-6]), walker([2.0, 4.0, 6.0, 8.0, 7.0, 8.0])
    result = benchmark({"quick": quick, "slow": slow}, [pull(10.0), pull(10.0)])
    assert result.tasks == 2
    mine, theirs = result.performances["quick"], result.performances["slow"]
    assert mine.total_energy == pytest.approx(2e-6, rel=1e-3)
    assert theirs.total_energy == pytest.approx(4.0)
    assert result.energy_ratio("slow", "quick") == pytest.approx(2e6, rel=1e-3)
    # The slow one is first at its final energy after four of six ticks.
    assert theirs.reach["slow"].seconds == pytest.approx(2 * 4 * TICK, rel=0.5)
    assert result.time_ratio("quick", "slow") == pytest.approx(0.25, rel=0.5)
    assert math.isinf(result.time_ratio("slow", "quick"))
    assert theirs.reach["quick"].missed == 2
    assert (mine.higher, theirs.higher) == ({"slow": 0}, {"quick": 2})
    assert mine.repetitions == 2


def test_a_solver_that_ends_no_lower_than_it_started_gives_no_ratio() -> None:
    result = benchmark({"good": walker([9.0]), "lost": walker([-5.0])}, [pull(10.0)], repeats=1)
    assert math.isnan(result.time_ratio("good", "lost"))


def test_a_curve_starts_at_the_common_start_and_ends_at_the_final_energies() -> None:
    result = benchmark({"a": walker([5.0]), "b": walker([1.0, 2.0, 3.0, 4.0])}, [pull(10.0), pull(20.0)], repeats=1)
    for name, end in (("a", 5.0 + 15.0), ("b", 6.0 + 16.0)):
        performance = result.performances[name]
        assert performance.curve[0] == (0.0, pytest.approx(30.0))
        assert performance.curve[-1] == (pytest.approx(performance.seconds, rel=1e-6), pytest.approx(end))
        assert (np.diff([energy for _, energy in performance.curve]) <= 1e-12).all()


def test_the_budget_ends_repetitions_but_never_the_first() -> None:
    tasks = [pull(10.0)]
    result = run_benchmark("pull", "x", tasks, {"a": walker([1.0])}, repeats=5, budget_seconds=0.0)
    assert result.performances["a"].repetitions == 1


def test_the_recorder_keeps_stages_and_starts() -> None:
    recorder = TaskRecorder(walker([1.0]))
    task = pull(3.0)
    solved, _ = recorder(task.stage, task.start)
    assert solved[INTRINSICS][0, 0] == 1.0
    assert [(t.stage, t.start) for t in recorder.tasks] == [(task.stage, task.start)]
    assert (task.kind, task.stage.name) == ("pull", "pull[0-1]")


def test_cancelling_a_benchmark() -> None:
    def cancelled(stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        return run_stage(stage, state, hooks)

    stop: Callable[[], bool] = lambda: True  # noqa: E731
    with pytest.raises(Cancelled):
        run_benchmark("pull", "x", [pull(1.0)], {"a": cancelled}, repeats=1, budget_seconds=1.0, should_stop=stop)


def test_peak_memory_sees_what_was_allocated_and_freed() -> None:
    with PeakMemory() as peak:
        block = np.ones(64 * 1024 * 1024 // 8)
        del block
    if peak.extra_mb is None:
        pytest.skip("this system does not tell the peak memory")
    assert 60.0 < peak.extra_mb < 80.0
