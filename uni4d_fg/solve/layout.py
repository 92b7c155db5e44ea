"""Where the entries of the variables stand in one dense vector."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.graph.state import TANGENT_DIM, State


@dataclass(frozen=True)
class DenseLayout:
    """Columns of the non-eliminated groups, frozen entries included (they are cut out at the solve)."""

    offset: Mapping[str, int]
    count: Mapping[str, int]
    size: int
    free: BoolArray
    """(size,) which columns may move."""

    @classmethod
    def create(cls, state: State, free: Mapping[str, BoolArray], groups: tuple[str, ...]) -> DenseLayout:
        """Lay the named groups out one after another."""
        offset, count, masks, size = {}, {}, [np.zeros(0, dtype=bool)], 0
        for group in groups:
            offset[group], count[group] = size, len(state[group])
            masks.append(free[group].reshape(-1))
            size += len(state[group]) * TANGENT_DIM[group]
        return cls(offset, count, size, np.concatenate(masks))

    def columns(self, group: str, rows: IntArray) -> IntArray:
        """Return the columns (..., dim) of rows (...) of a group."""
        dim = TANGENT_DIM[group]
        result: IntArray = self.offset[group] + rows[..., None] * dim + np.arange(dim)
        return result

    def split(self, vector: FloatArray) -> dict[str, FloatArray]:
        """Cut a vector (size,) into groups (n, dim)."""
        out = {}
        for group, start in self.offset.items():
            dim = TANGENT_DIM[group]
            out[group] = vector[start : start + self.count[group] * dim].reshape(-1, dim)
        return out

    def locate(self, column: int) -> tuple[str, int, int]:
        """Return the group, row and component of a column."""
        for group, start in self.offset.items():
            dim = TANGENT_DIM[group]
            if start <= column < start + self.count[group] * dim:
                return group, (column - start) // dim, (column - start) % dim
        raise IndexError(column)
