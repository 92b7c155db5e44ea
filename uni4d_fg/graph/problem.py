"""A nonlinear least-squares problem: factor batches and which entries of the variables are free."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.graph.state import TANGENT_DIM, State


@dataclass(frozen=True)
class Problem:
    """Minimise the sum of the batches' energies over the free entries.

    Freezing is orthogonal to the terms: a factor never knows which of its variables move.
    """

    batches: tuple[FactorBatch, ...]
    free: Mapping[str, BoolArray]
    """Per group (n, tangent dim); a group that is absent is frozen."""

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term name."""
        out: dict[str, float] = {}
        for batch in self.batches:
            out[batch.name] = out.get(batch.name, 0.0) + batch.energy(state)
        return out

    def is_free(self, group: str) -> bool:
        """Return whether any entry of a group may move."""
        return group in self.free and bool(self.free[group].any())

    def free_rows(self) -> dict[str, BoolArray]:
        """Return per free group the rows (n,) with at least one free entry."""
        return {group: np.asarray(mask.any(axis=1)) for group, mask in self.free.items() if mask.any()}


def all_free(state: State, *groups: str) -> dict[str, BoolArray]:
    """Return a ``free`` mapping in which every entry of the named groups may move."""
    return {group: np.ones((len(state[group]), TANGENT_DIM[group]), dtype=bool) for group in groups}
