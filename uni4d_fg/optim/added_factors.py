"""A user's own factors and variables in any stage, whatever solves it.

    def gps(stage, state):
        if stage.kind != "bundle_adjustment":
            return None
        return Addition([position_prior(frames, xyz=measured, sigma=0.05)])

    reconstruct(sequence, folder, config, additions=[gps])

A source is asked before every solve. What it returns joins the problem; new variables start where it says, keep their
values from solve to solve under their keys, and do not appear in what the stage hands on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.optim.summary import SolveSummary

HOLDS_SCALE = "added_factors_hold_the_scale"
"""Note in the summary of a solve whose scale the depth cue's mean must not set."""


@dataclass(frozen=True)
class Addition:
    """What joins a problem."""

    factors: Sequence[Any]
    """Batches, ``gtsam`` factors and graphs, as :meth:`uni4d_fg.optim.problem.Problem.add` takes them."""
    variables: Mapping[VariableType, FloatArray] = field(default_factory=dict)
    """Starting values of variables that the stage does not have."""
    index: Mapping[VariableType, IntArray] = field(default_factory=dict)
    """Numbers of their keys; row numbers where a type is absent."""
    free: Mapping[VariableType, BoolArray] = field(default_factory=dict)
    """Free entries (n, dim) of types whose freedom shall be other than the stage's own."""
    replaces: Sequence[FactorType] = ()
    """Terms of the stage's own that these factors take the place of."""
    is_metric: bool = True
    """Whether the factors know lengths: the mean of the depth cue then no longer sets the scale of the world."""


FactorSource: TypeAlias = Callable[[Stage, State], Addition | None]
"""``source(stage, state)``: what joins the problem of a stage that is about to be solved; None for nothing."""


@dataclass
class AddingRunner:
    """A ``StageRunner`` that adds factors to every stage before another one solves it.

    Raises:
        SolverError: On a call, if a source declares a variable that the stage has, or a factor does not fit.
    """

    run: StageRunner
    sources: Sequence[FactorSource]
    known: dict[VariableType, dict[tuple[int, ...], FloatArray]] = field(default_factory=dict)
    """Last values of added variables, by the numbers of their keys."""

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage with what the sources add."""
        additions = self._asked(stage, state)
        if not additions:
            return self.run(stage, state, hooks)
        whole, joined = self._whole(additions, stage, state)
        solved, summary = self.run(whole, joined, hooks)
        if any(addition.is_metric for addition in additions):
            summary = replace(summary, notes={**summary.notes, HOLDS_SCALE: True})
        for variable in (v for v in joined.arrays if v not in state):
            values = zip(map(tuple, joined.numbers(variable).tolist()), solved[variable], strict=True)
            self.known.setdefault(variable, {}).update(values)
        kept = {variable: array for variable, array in solved.arrays.items() if variable in state}
        return State(kept, state.index), summary

    def as_solved(self, stage: Stage, state: State) -> tuple[Stage, State]:
        """Return a stage with what the sources add to it, and a state with the last values of what they add."""
        additions = self._asked(stage, state)
        if additions:
            stage, state = self._whole(additions, stage, state)
        return as_solved(self.run, stage, state)

    def _asked(self, stage: Stage, state: State) -> list[Addition]:
        return [found for source in self.sources if (found := source(stage, state)) is not None]

    def _whole(self, additions: list[Addition], stage: Stage, state: State) -> tuple[Stage, State]:
        joined, added = self._joined(additions, state)
        replaced = {kind for addition in additions for kind in addition.replaces}
        own = tuple(batch for batch in stage.problem.batches if batch.factor_type not in replaced)
        problem = replace(stage.problem, batches=own)
        problem.free = {**problem.free, **{v: np.ones((len(joined[v]), v.dim), dtype=bool) for v in added}}
        for addition in additions:
            problem.add(*addition.factors, state=joined)
            problem.free = {**problem.free, **addition.free}
        return replace(stage, problem=problem), joined

    def _joined(self, additions: list[Addition], state: State) -> tuple[State, list[VariableType]]:
        arrays, index, added = dict(state.arrays), dict(state.index), []
        for addition in additions:
            for variable, values in addition.variables.items():
                if variable in arrays:
                    raise SolverError(f"an added factor brings {variable} variables, which the stage has already")
                numbers = addition.index.get(variable)
                arrays[variable] = np.array(values, dtype=np.float64)
                if numbers is not None:
                    index[variable] = numbers
                added.append(variable)
        joined = State(arrays, index)
        for variable in added:
            known = self.known.get(variable, {})
            for row, number in enumerate(map(tuple, joined.numbers(variable).tolist())):
                if number in known:
                    joined.arrays[variable][row] = known[number]
        return joined, added


def with_additions(run: StageRunner, sources: Sequence[FactorSource]) -> StageRunner:
    """Return a runner that adds what the sources say; the runner itself without sources."""
    return AddingRunner(run, sources) if sources else run


def as_solved(run: StageRunner, stage: Stage, state: State) -> tuple[Stage, State]:
    """Return a stage and its solution as a runner solved them, with everything that was added; for covariances."""
    return run.as_solved(stage, state) if isinstance(run, AddingRunner) else (stage, state)
