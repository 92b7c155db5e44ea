"""A solved stage as GTSAM holds it: a factor graph, the values it started from and those it ended at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import gtsam

from uni4d_fg.arrays import BoolArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
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
        return self.initial_state.to_values(self._read)

    @cached_property
    def final(self) -> gtsam.Values:
        """Values after the solve."""
        return self.final_state.to_values(self._read)

    @property
    def num_variables(self) -> int:
        """Number of variables that a factor reads."""
        return sum(int(rows.sum()) for variable, rows in self._read.items() if variable in self.final_state)

    def values_text(self) -> Iterator[tuple[str, str]]:
        """Yield names and texts of files that ``gtsam.Values().deserialize`` reads, of both ends.

        The names are ``KIND.initial.values`` and ``KIND.final.values``. Of what is yielded nothing is kept.
        """
        for end, state in (("initial", self.initial_state), ("final", self.final_state)):
            yield f"{self.kind}.{end}.values", state.to_values(self._read).serialize()

    @cached_property
    def _read(self) -> dict[VariableType, BoolArray]:
        return variables_read(self.problem, self.final_state)


@dataclass
class RecordingRunner:
    """A ``StageRunner`` that remembers the last solve of every kind."""

    run: StageRunner
    kinds: frozenset[str] | None = None
    """Kinds that are remembered; all when None."""
    solved: dict[str, StageGraph] = field(default_factory=dict)

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage."""
        self.solved.pop(stage.kind, None)  # not while another is made: of a long video each is hundreds of MB
        final, summary = self.run(stage, state, hooks)
        if stage.reads_free_variables and (self.kinds is None or stage.kind in self.kinds):
            self.solved[stage.kind] = StageGraph(stage.kind, stage.problem, state, final)
        return final, summary
