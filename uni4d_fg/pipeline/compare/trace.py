"""Exact energy against wall time: one solve by one solver."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.errors import Cancelled
from uni4d_fg.factors.state import State
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.pipeline.compare.task import Task

EQUAL = 1e-6
"""Two energies this close, relatively, are equal, and one of them reached by the other."""


@dataclass(frozen=True)
class Trace:
    """One solve."""

    seconds: FloatArray
    """(n,) since the solver was called, ascending from 0."""
    energies: FloatArray
    """(n,) exact energy at those times."""
    final: dict[str, float]
    """Exact energy per term at the end."""
    iterations: int
    termination: str

    @property
    def energy(self) -> float:
        """Total exact energy at the end."""
        return sum(self.final.values())

    @property
    def total_seconds(self) -> float:
        """Wall time of the solve."""
        return float(self.seconds[-1])

    def time_to_reach(self, energy: float) -> float:
        """Return the first time at which the energy is at most ``energy``, s; infinity if it never is."""
        reached = np.flatnonzero(self.energies <= energy * (1.0 + EQUAL))
        return float(self.seconds[reached[0]]) if len(reached) else math.inf


def trace_solve(run: StageRunner, task: Task, should_stop: Callable[[], bool] | None = None) -> Trace:
    """Solve a task and record the exact energy on the way.

    Of Levenberg-Marquardt every accepted state counts from the moment it is there, all set-up included, and is
    scored after the solve. Of a descent, whose loss is the exact energy up to rounding, every loss counts; its
    clock leaves out the scoring before and after the descent.

    Raises:
        Cancelled: If ``should_stop`` turned true.
        SolverError: If the solver fails.
    """
    moments: list[tuple[float, State]] = []
    began = time.perf_counter()
    hooks = Hooks(should_stop=should_stop, on_state=lambda state: moments.append((time.perf_counter() - began, state)))
    solved, summary = run(task.stage, task.start, hooks)
    if summary.termination is Termination.CANCELLED:
        raise Cancelled("stopped while comparing")
    first, final = sum(task.score(task.start).values()), task.score(solved)
    if "descend" in summary.seconds:
        seconds, energies = _descent_curve(summary)
    else:
        seconds = [at for at, _ in moments]
        energies = [sum(task.score(state).values()) for _, state in moments]
        if moments:  # what was worked after the last accepted step is time too
            seconds, energies = [*seconds, max(summary.seconds["total"], seconds[-1])], [*energies, energies[-1]]
    seconds, energies = [0.0, *seconds], [first, *energies]
    energies[-1] = sum(final.values())
    return Trace(np.array(seconds), np.array(energies), final, len(summary.iterations), summary.termination.value)


def _descent_curve(summary: SolveSummary) -> tuple[list[float], list[float]]:
    """Return times after every step and the losses there; the loss of the last step is not known."""
    prepared = summary.seconds["prepare"]
    seconds = [prepared + record.seconds for record in summary.iterations]
    energies = [record.energy for record in summary.iterations[1:]]
    return seconds, [*energies, math.nan] if seconds else energies
