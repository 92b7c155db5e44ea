"""A solved stage as GTSAM holds it: a factor graph, the values it started from and those it ended at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import gtsam

from uni4d_fg.factors.state import State
from uni4d_fg.optim.gtsam_graph import to_gtsam, variables_read
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.optim.summary import SolveSummary


@dataclass(frozen=True)
class StageGraph:
    """One solve: the problem on arrays, and the same as GTSAM's graph and values."""

    kind: str
    problem: Problem
    initial_state: State
    final_state: State
    left_out: Mapping[str, int] = field(default_factory=dict)
    """Factors that the solve had and a file could not hold, by term: those that exist as Python functions alone."""

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Custom factors stacked per landmark, track or frame pair, native factors as they were given."""
        return to_gtsam(self.problem, self.final_state, native=False)[0]

    @cached_property
    def initial(self) -> gtsam.Values:
        """Values before the solve."""
        return self.initial_state.to_values(variables_read(self.problem, self.initial_state))

    @cached_property
    def final(self) -> gtsam.Values:
        """Values after the solve."""
        return self.final_state.to_values(variables_read(self.problem, self.final_state))

    def values_text(self) -> dict[str, str]:
        """Return files that ``gtsam.Values().deserialize`` reads: ``KIND.initial.values``, ``KIND.final.values``."""
        ends = (("initial", self.initial), ("final", self.final))
        return {f"{self.kind}.{name}.values": values.serialize() for name, values in ends}


@dataclass
class RecordingRunner:
    """A ``StageRunner`` that remembers the last solve of every kind."""

    run: StageRunner
    solved: dict[str, StageGraph] = field(default_factory=dict)

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage."""
        final, summary = self.run(stage, state, hooks)
        if stage.reads_free_variables:
            self.solved[stage.kind] = StageGraph(stage.kind, stage.problem, state, final)
        return final, summary
