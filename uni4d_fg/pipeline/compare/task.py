"""The solves of a stage, written down so that any solver can repeat them from the same start."""

from __future__ import annotations

from dataclasses import dataclass, field

from uni4d_fg.factors.priors import scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.optim.summary import SolveSummary


@dataclass(frozen=True)
class Task:
    """One solve: a declared stage and the state it starts from."""

    stage: Stage
    start: State

    @property
    def kind(self) -> str:
        """Name of the stage without the frames of its window."""
        return self.stage.kind

    def score(self, state: State) -> dict[str, float]:
        """Return the exact energy per term at ``state``.

        The anchor of the scale is left out: it chooses among states of equal energy and is no part of it.
        """
        batches = tuple(b for b in self.stage.problem.batches if b.factor_type is not scale_anchor)
        return Problem(batches).energies(state, exact=True)


@dataclass
class TaskRecorder:
    """A ``StageRunner`` that hands its solves to another one and writes them down."""

    run: StageRunner
    tasks: list[Task] = field(default_factory=list)

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage."""
        if stage.reads_free_variables:
            self.tasks.append(Task(stage.unbounded(), state))
        return self.run(stage, state, hooks)
