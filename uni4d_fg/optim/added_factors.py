"""A user's own factors and variables in any stage, whatever solves it.

    def gps(stage, state):
        if not stage.finds_cameras:
            return None
        return Addition([position_prior(frames, xyz=measured, sigma=0.05)])

    reconstruct(sequence, folder, config, additions=[gps])

A source is asked before every solve. What it returns joins the problem; new variables start where it says, keep their
values from solve to solve under their keys, and do not appear in what the stage hands on.

Keys count frames from the start of the video, also where a state has only some of them (a window, a stream): factors of
GTSAM's that read a frame or a track which the state does not list are left out. Batches count rows of the state;
``state.numbers(POSE)[:, 0]`` are the frames of its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import gtsam
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType, locate
from uni4d_fg.factors.variable_types import CUE_SCALE
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.metric_scale import common_log_scale, release_scale
from uni4d_fg.optim.problem import Problem, flat_factors
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.optim.summary import SolveSummary

HOLDS_SCALE = "added_factors_hold_the_scale"
"""Note in the summary of a solve whose scale the depth cue's mean must not set."""
LEFT_OUT = "added_factors_left_out"
"""Note in the summary of a solve: number of added factors on frames or tracks that it does not have."""

Numbers: TypeAlias = tuple[int, ...]
"""The numbers of one key."""


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
"""``source(stage, state)``: what joins the problem of a stage that is about to be solved; None for nothing.

A source with an attribute ``fingerprint``, a text, is part of what a resumed run compares from bundle adjustment on.
"""


@dataclass
class AddedValues:
    """Last values of added variables, by the numbers of their keys."""

    values: dict[VariableType, dict[Numbers, FloatArray]] = field(default_factory=dict)

    def take(self, state: State, added: Sequence[VariableType]) -> None:
        """Remember the values that a state has of the given types."""
        for variable in added:
            rows = zip(map(tuple, state.numbers(variable).tolist()), state[variable], strict=True)
            self.values.setdefault(variable, {}).update(rows)

    def forget(self, variable: VariableType, numbers: Iterable[Numbers]) -> None:
        """Drop the values under the given numbers."""
        for number in numbers:
            self.of(variable).pop(number, None)

    def of(self, variable: VariableType) -> dict[Numbers, FloatArray]:
        """Return the values of a type."""
        return self.values.get(variable, {})


@dataclass(frozen=True)
class JoinedStage:
    """A stage with what was added to it."""

    stage: Stage
    state: State
    """Of the stage, and the added variables."""
    added: tuple[VariableType, ...] = ()
    """Types that the stage itself does not have."""
    is_metric: bool = False
    left_out: int = 0
    """Factors on frames or tracks that the state does not have."""


def join_additions(
    sources: Sequence[FactorSource],
    stage: Stage,
    state: State,
    known: AddedValues,
    kept: Mapping[VariableType, Sequence[Numbers]] | None = None,
) -> JoinedStage:
    """Ask the sources and put what they say into a stage.

    Args:
        sources: What is asked.
        stage: About to be solved; not changed.
        state: Where it starts.
        known: Values that added variables start at rather than where a source says.
        kept: Added variables, all known, that must be there though no source names them: those of a prior.

    Raises:
        SolverError: If a source returns something else than an addition, declares a variable that the stage has, or a
            factor does not fit.
    """
    additions = [found for source in sources if (found := _asked(source, stage, state)) is not None]
    if not additions and not kept:
        return JoinedStage(stage, state)
    is_metric = any(addition.is_metric for addition in additions)
    replaced = {kind for addition in additions for kind in addition.replaces}
    own = tuple(batch for batch in stage.problem.batches if batch.factor_type not in replaced)
    problem = replace(stage.problem, batches=own)
    common = common_log_scale(problem, state) if is_metric else None
    if common is not None:
        additions.append(Addition([], {CUE_SCALE: common}))
    joined, free = _joined_state(additions, state, AddedValues() if stage.own_world else known, kept or {})
    problem.free = {**problem.free, **free}
    if is_metric:
        release_scale(problem, common=common is not None)
    left_out = _add_factors(problem, additions, joined, state)
    added = tuple(variable for variable in joined.arrays if variable not in state)
    return JoinedStage(replace(stage, problem=problem), joined, added, is_metric, left_out)


def checked_sources(additions: Iterable[FactorSource]) -> tuple[FactorSource, ...]:
    """Return what a caller gave as its additions, as sources.

    Raises:
        SolverError: If that is no list of functions.
    """
    if callable(additions):
        raise SolverError(f"additions: a list of sources is expected, not one alone; give [{_name(additions)}]")
    if not isinstance(additions, Iterable):
        raise SolverError(f"additions: a list of sources is expected, got {_name(additions)}")
    sources = tuple(additions)
    for source in sources:
        if not callable(source):
            raise SolverError(
                f"additions: a source is a function of stage and state that returns an Addition or None, got "
                f"{_name(source)}"
            )
    return sources


def _asked(source: FactorSource, stage: Stage, state: State) -> Addition | None:
    """Return what a source says of a stage."""
    found = source(stage, state)
    if found is not None and not isinstance(found, Addition):
        raise SolverError(
            f"{stage.name}: the source {_name(source)} returned {_name(found)}, but an Addition or None is expected"
        )
    return found


def _name(thing: Any) -> str:
    """Return the name of a function, or of the type of anything else."""
    return str(getattr(thing, "__name__", type(thing).__name__))


def _joined_state(
    additions: Sequence[Addition],
    state: State,
    known: AddedValues,
    kept: Mapping[VariableType, Sequence[Numbers]],
) -> tuple[State, dict[VariableType, BoolArray]]:
    """Return the state with the added variables, a source's own rows first, and what is free beside the stage's own."""
    arrays, index = dict(state.arrays), dict(state.index)
    free: dict[VariableType, BoolArray] = {}
    for addition in additions:
        free.update({v: mask for v, mask in addition.free.items() if v not in addition.variables})
        for variable, values in addition.variables.items():
            if variable in arrays:
                raise SolverError(f"an added factor brings {variable} variables, which the stage has already")
            arrays[variable] = np.array(values, dtype=np.float64)
            if variable in addition.index:
                index[variable] = addition.index[variable]
            free[variable] = np.ones((len(values), variable.dim), dtype=bool)
            free[variable] = addition.free.get(variable, free[variable])
    for variable, numbers in kept.items():
        own = State({variable: arrays.get(variable, np.zeros((0, *variable.manifold.shape)))}, index).numbers(variable)
        more = [n for n in numbers if n not in set(map(tuple, own.tolist()))]
        if more:
            values = np.stack([known.of(variable)[n] for n in more])
            arrays[variable] = np.concatenate([arrays[variable], values]) if len(own) else values
            index[variable] = np.concatenate([own, np.array(more, dtype=np.int64).reshape(len(more), -1)])
            mask = free.get(variable, np.zeros((0, variable.dim), dtype=bool))
            free[variable] = np.concatenate([mask, np.ones((len(more), variable.dim), dtype=bool)])
    joined = State(arrays, index)
    for variable in arrays:
        if variable not in state and known.of(variable):
            for row, number in enumerate(map(tuple, joined.numbers(variable).tolist())):
                arrays[variable][row] = known.of(variable).get(number, arrays[variable][row])
    return joined, free


def _add_factors(problem: Problem, additions: Sequence[Addition], joined: State, own: State) -> int:
    """Add the factors, but GTSAM's on keys that the stage's own state could list and does not; return how many."""
    listed: dict[VariableType, set[int]] = {}

    def is_elsewhere(key: int) -> bool:
        found = locate(key)
        if found is None or found[0] not in own or found[0] not in own.index:
            return False
        if found[0] not in listed:
            listed[found[0]] = set(own.keys(found[0]))
        return key not in listed[found[0]]

    here, left_out = [], 0
    for item in flat_factors(addition.factors for addition in additions):
        if isinstance(item, gtsam.NonlinearFactor) and any(is_elsewhere(key) for key in list(item.keys())):
            left_out += 1
        else:
            here.append(item)
    problem.add(here, state=joined)
    return left_out


@dataclass
class AddingRunner:
    """A ``StageRunner`` that adds factors to every stage before another one solves it.

    Raises:
        SolverError: On a call, if a source declares a variable that the stage has, or a factor does not fit.
    """

    run: StageRunner
    sources: Sequence[FactorSource]
    known: AddedValues = field(default_factory=AddedValues)

    def joined(self, stage: Stage, state: State) -> JoinedStage:
        """Return a stage with what the sources add."""
        return join_additions(self.sources, stage, state, self.known)

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage with what the sources add."""
        joined = self.joined(stage, state)
        solved, summary = self.run(joined.stage, joined.state, hooks)
        if joined.is_metric:
            summary = replace(summary, notes={**summary.notes, HOLDS_SCALE: True})
        if joined.left_out:
            summary = replace(summary, notes={**summary.notes, LEFT_OUT: joined.left_out})
        if not stage.own_world:
            self.known.take(solved, joined.added)
        return State({v: array for v, array in solved.arrays.items() if v in state}, state.index), summary


def with_additions(run: StageRunner, sources: Sequence[FactorSource]) -> StageRunner:
    """Return a runner that adds what the sources say; the runner itself without sources."""
    return adding_to(run, sources) if sources else run


def adding_to(run: StageRunner, sources: Sequence[FactorSource]) -> AddingRunner:
    """Return a runner that adds what the sources say, after those of its own if it has any."""
    if isinstance(run, AddingRunner):
        return AddingRunner(run.run, (*run.sources, *sources), run.known)
    return AddingRunner(run, sources)


def joined_by(run: StageRunner, stage: Stage, state: State) -> JoinedStage:
    """Return a stage as a runner would solve it: with what its sources add, if it has any."""
    return run.joined(stage, state) if isinstance(run, AddingRunner) else JoinedStage(stage, state)


def fingerprints(sources: Sequence[FactorSource]) -> list[str]:
    """Return the fingerprints of the sources that have one."""
    found = (getattr(source, "fingerprint", None) for source in sources)
    return [text for text in found if isinstance(text, str)]
