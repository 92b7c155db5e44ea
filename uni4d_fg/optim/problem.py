"""A nonlinear least-squares problem, put together from factors of any kind.

    problem = Problem.over(state)
    problem.add(static_reprojection(frame, row, 0, uv=uv, sigma=0.7))     # batches of our factor types
    problem.add(gtsam.PriorFactorPose3(key, pose, noise))                 # GTSAM's own factors, in any number
    problem.fix(POSE, rows=[0]).eliminate(LANDMARK)
    state, summary = solve(problem, state)

Freezing is orthogonal to the terms: a factor never knows which of its variables move.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import BoolArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.native_factors import native_batches

Free = Mapping[VariableType, BoolArray]
"""Free entries per variable type, (n, tangent dim); a type that is absent is frozen."""


@dataclass
class Problem:
    """Minimize the sum of the factors' energies over the free entries."""

    batches: tuple[FactorBatch, ...] = ()
    free: Free = field(default_factory=dict)
    eliminated: VariableType | None = None
    """Points that are eliminated before the other variables are solved."""

    @classmethod
    def over(cls, state: State) -> Problem:
        """Return a problem without factors in which every variable of a state may move."""
        return cls((), all_free(state, *state.arrays))

    def add(self, *factors: Any, state: State | None = None) -> Problem:
        """Add factors.

        Args:
            factors: Batches, ``gtsam`` factors and graphs, and iterables of these.
            state: Names the keys of ``gtsam`` factors; needed for these. Batches are checked against it.

        Returns:
            Itself.

        Raises:
            SolverError: If a factor reads a variable that the state does not have, no state is given for a ``gtsam``
                factor, or something is no factor.
        """
        batches, native = [], []
        for item in flat_factors(factors):
            if isinstance(item, gtsam.NonlinearFactor):
                native.append(item)
            else:
                batches.append(item)
        if native:
            if state is None:
                raise SolverError(
                    "a factor of GTSAM's needs the state whose keys it reads: problem.add(f, state=state)"
                )
            batches += native_batches(native, state)
        if state is not None:
            check_rows(batches, state)
        self.batches = (*self.batches, *batches)
        return self

    def fix(
        self,
        variable: VariableType,
        rows: IntArray | Sequence[int] | None = None,
        entries: Sequence[int] | None = None,
    ) -> Problem:
        """Freeze variables: all of a type, some rows, or some entries of the tangent. Returns itself.

        A type that the problem does not have, or that is frozen already, is left alone.
        """
        if variable not in self.free:
            return self
        mask = self.free[variable].copy()
        chosen = np.arange(len(mask)) if rows is None else np.asarray(rows, dtype=np.int64)
        columns = np.arange(variable.dim) if entries is None else np.asarray(entries, dtype=np.int64)
        mask[np.ix_(chosen, columns)] = False
        self.free = {**self.free, variable: mask}
        if not mask.any():
            self.free = {v: m for v, m in self.free.items() if v is not variable}
        return self

    def eliminate(self, variable: VariableType | None) -> Problem:
        """Choose the points that are eliminated first; no factor may read two of them. Returns itself."""
        self.eliminated = variable
        return self

    def energies(self, state: State, *, exact: bool = False) -> dict[str, float]:
        """Return the energy per term name; ``exact`` leaves out the smoothing of 'norm' kernels."""
        out: dict[str, float] = {}
        for batch in self.batches:
            out[batch.name] = out.get(batch.name, 0.0) + batch.energy(state, exact=exact)
        return out

    def energy(self, state: State, *, exact: bool = False) -> float:
        """Return the sum of :meth:`energies`."""
        return sum(self.energies(state, exact=exact).values())

    def is_free(self, variable: VariableType) -> bool:
        """Return whether any entry of a variable type may move."""
        return variable in self.free and bool(self.free[variable].any())

    def is_free_in_part(self, variable: VariableType) -> bool:
        """Return whether a variable of a type has entries that may move and others that may not."""
        mask = self.free.get(variable)
        return mask is not None and bool((mask.any(axis=1) & ~mask.all(axis=1)).any())

    def free_rows(self) -> dict[VariableType, BoolArray]:
        """Return per free variable type the rows (n,) with at least one free entry."""
        return {variable: np.asarray(mask.any(axis=1)) for variable, mask in self.free.items() if mask.any()}


def all_free(state: State, *variables: VariableType) -> dict[VariableType, BoolArray]:
    """Return a ``free`` mapping in which every entry of the given types may move."""
    return {variable: np.ones((len(state[variable]), variable.dim), dtype=bool) for variable in variables}


def check_rows(batches: Iterable[FactorBatch], state: State) -> None:
    """Check that a state has every variable that factors read.

    Raises:
        SolverError: If it does not; names the term and the variable.
    """
    for batch in batches:
        batch.check_rows(state)


def flat_factors(items: Iterable[Any]) -> Iterable[Any]:
    """Yield the single batches and ``gtsam`` factors of nested iterables and graphs.

    Raises:
        SolverError: If something else is in them.
    """
    for item in items:
        if isinstance(item, gtsam.NonlinearFactorGraph):
            yield from (item.at(i) for i in range(item.size()) if item.at(i) is not None)
        elif isinstance(item, FactorBatch | gtsam.NonlinearFactor):
            yield item
        elif isinstance(item, Iterable) and not isinstance(item, str):
            yield from flat_factors(item)
        else:
            raise SolverError(f"a batch of factors or a factor of GTSAM's is expected, got {type(item).__name__}")
