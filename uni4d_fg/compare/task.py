"""The solves of a stage, written down so that any solver can repeat them from the same start."""

from __future__ import annotations

from dataclasses import dataclass, field

from uni4d_fg.energy import exact_energy
from uni4d_fg.factors.priors import SCALE_ANCHOR
from uni4d_fg.graph.state import State
from uni4d_fg.solve.levenberg_marquardt import Hooks
from uni4d_fg.solve.summary import SolveSummary
from uni4d_fg.stages.stage import Stage, StageRunner


@dataclass(frozen=True)
class Task:
    """One solve: a declared stage and the state it starts from."""

    stage: Stage
    start: State

    @property
    def kind(self) -> str:
        """Name of the stage without the frames of its window."""
        return self.stage.name.partition("[")[0]

    def score(self, state: State) -> dict[str, float]:
        """Return the exact energy per term at ``state``.

        The anchor of the scale is left out: it chooses among states of equal energy and is no part of it.
        """
        return exact_energy((b for b in self.stage.batches if b.family is not SCALE_ANCHOR), state)


@dataclass
class TaskRecorder:
    """A ``StageRunner`` that hands its solves to another one and writes them down."""

    run: StageRunner
    tasks: list[Task] = field(default_factory=list)

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage."""
        if stage.reads_free_variables:
            self.tasks.append(Task(stage, state))
        return self.run(stage, state, hooks)
