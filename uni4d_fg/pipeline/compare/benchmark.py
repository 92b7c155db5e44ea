"""A benchmark: several solvers on the same tasks, repeated, and what one needs to reach another's energy."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.compare.memory import PeakMemory
from uni4d_fg.pipeline.compare.task import Task
from uni4d_fg.pipeline.compare.trace import EQUAL, Trace, trace_solve

_CURVE_POINTS = 120
_WARM_UP_POLLS = 3


@dataclass(frozen=True)
class Reach:
    """How long a solver took to the final energies of another, summed over the tasks."""

    seconds: float
    """A task in which it never got there counts with the whole time of its solve."""
    missed: int
    """Number of those tasks."""


@dataclass(frozen=True)
class Performance:
    """What one solver did in a benchmark; times are medians over the repetitions."""

    energy: dict[str, float]
    """Final exact energy per term, summed over the tasks."""
    seconds: float
    iterations: int
    repetitions: int
    extra_memory_mb: float | None
    """Peak resident memory above that before the solves; None where the system does not tell."""
    reach: dict[str, Reach]
    """Per solver, itself included: the way to that one's final energies."""
    higher: dict[str, int]
    """Per other solver: tasks that end above it."""
    curve: list[tuple[float, float]]
    """Seconds and energy, both summed over tasks that each had the same time so far."""

    @property
    def total_energy(self) -> float:
        """Sum over terms and tasks."""
        return sum(self.energy.values())


@dataclass(frozen=True)
class Benchmark:
    """All solvers on one kind of task from one start."""

    kind: str
    """Name of the stage."""
    start: str
    """Whose previous stage the tasks start from; 'common' where there is none."""
    tasks: int
    performances: dict[str, Performance]

    def time_ratio(self, solver: str, opponent: str) -> float:
        """Return the solver's time to the opponent's final energies over the opponent's own.

        Infinite if it never gets there, NaN if the opponent ends no lower than it started.
        """
        return time_ratio([self], solver, opponent)

    def energy_ratio(self, solver: str, opponent: str) -> float:
        """Return the solver's final energy over the opponent's."""
        theirs = self.performances[opponent].total_energy
        mine = self.performances[solver].total_energy
        return mine / theirs if theirs > 0 else (1.0 if mine == theirs else math.inf)


def time_ratio(benchmarks: list[Benchmark], solver: str, opponent: str) -> float:
    """Return the ratio of :meth:`Benchmark.time_ratio` over several benchmarks, times added."""
    return math.inf if missed_tasks(benchmarks, solver, opponent) else spent_ratio(benchmarks, solver, opponent)


def missed_tasks(benchmarks: list[Benchmark], solver: str, opponent: str) -> int:
    """Return in how many tasks the solver never gets to the opponent's final energy."""
    return sum(benchmark.performances[solver].reach[opponent].missed for benchmark in benchmarks)


def spent_ratio(benchmarks: list[Benchmark], solver: str, opponent: str) -> float:
    """Return :func:`time_ratio`, but count a task in which the solver never gets there with all of its time."""
    spent = sum(benchmark.performances[solver].reach[opponent].seconds for benchmark in benchmarks)
    theirs = sum(benchmark.performances[opponent].reach[opponent].seconds for benchmark in benchmarks)
    return spent / theirs if theirs > 0.0 else math.nan


def run_benchmark(
    kind: str,
    start: str,
    tasks: list[Task],
    solvers: Mapping[str, StageRunner],
    *,
    repeats: int,
    budget_seconds: float,
    should_stop: Callable[[], bool] | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> Benchmark:
    """Let every solver do every task, in turns, after a warm-up that is not counted.

    Args:
        kind: Name of the stage.
        start: Whose previous stage the tasks start from.
        tasks: What to solve, at least one task.
        solvers: By name.
        repeats: Largest number of repetitions.
        budget_seconds: A solver is not repeated once it has used this much.
        should_stop: Polled; True raises.
        on_progress: Called with a line of text before every repetition.

    Raises:
        Cancelled: If ``should_stop`` turned true.
        SolverError: If a solver fails.
    """
    traces: dict[str, list[list[Trace]]] = {name: [] for name in solvers}
    spent = dict.fromkeys(solvers, 0.0)
    memory: dict[str, float | None] = {}
    for run in solvers.values():
        _warm_up(run, tasks[0])
    for repetition in range(repeats):
        for name, run in solvers.items():
            if repetition and spent[name] > budget_seconds:
                continue
            if on_progress is not None:
                on_progress(f"{kind} from {start}: {name}, repetition {repetition + 1}")
            began = time.perf_counter()
            with PeakMemory() as peak:
                traces[name].append([trace_solve(run, task, should_stop) for task in tasks])
            spent[name] += time.perf_counter() - began
            memory.setdefault(name, peak.extra_mb)
    performances = {name: _performance(name, traces, memory[name]) for name in solvers}
    return Benchmark(kind, start, len(tasks), performances)


def _warm_up(run: StageRunner, task: Task) -> None:
    """Load libraries and fill caches: a few iterations of one task."""
    polls = iter(range(1 << 30))
    run(task.stage, task.start, Hooks(should_stop=lambda: next(polls) >= _WARM_UP_POLLS))


def _performance(name: str, traces: Mapping[str, list[list[Trace]]], memory: float | None) -> Performance:
    mine = traces[name]
    first = mine[0]
    energy: dict[str, float] = {}
    for trace in first:
        for term, value in trace.final.items():
            energy[term] = energy.get(term, 0.0) + value
    goals = {other: [trace.energy for trace in runs[0]] for other, runs in traces.items()}
    return Performance(
        energy,
        float(np.median([sum(t.total_seconds for t in repetition) for repetition in mine])),
        sum(trace.iterations for trace in first),
        len(mine),
        memory,
        {other: _reach(mine, energies) for other, energies in goals.items()},
        {
            other: sum(t.energy > e * (1.0 + EQUAL) for t, e in zip(first, energies, strict=True))
            for other, energies in goals.items()
            if other != name
        },
        _curve(first),
    )


def _reach(repetitions: list[list[Trace]], energies: list[float]) -> Reach:
    seconds, missed = [], 0
    for traces in repetitions:
        times = [trace.time_to_reach(energy) for trace, energy in zip(traces, energies, strict=True)]
        missed = max(missed, sum(math.isinf(at) for at in times))
        seconds.append(sum(t.total_seconds if math.isinf(at) else at for t, at in zip(traces, times, strict=True)))
    return Reach(float(np.median(seconds)), missed)


def _curve(traces: list[Trace]) -> list[tuple[float, float]]:
    """Return the energy of all tasks together against the time spent on all of them.

    Every task has had the same time so far, or is finished: the sum then falls as one solve does.
    """
    longest = max(trace.total_seconds for trace in traces)
    earliest = min(float(trace.seconds[min(1, len(trace.seconds) - 1)]) for trace in traces)
    times = np.geomspace(max(min(earliest, longest), 1e-6), max(longest, 1e-6), _CURVE_POINTS)
    seconds: FloatArray = np.zeros(len(times))
    energies: FloatArray = np.zeros(len(times))
    for trace in traces:
        seconds += np.minimum(times, trace.total_seconds)
        energies += trace.energies[np.searchsorted(trace.seconds, times, side="right") - 1]
    start = sum(float(trace.energies[0]) for trace in traces)
    return [(0.0, start), *zip(seconds.tolist(), energies.tolist(), strict=True)]
