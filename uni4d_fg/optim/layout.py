"""Where the entries of the variables stand in one dense vector."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType


@dataclass(frozen=True)
class DenseLayout:
    """Columns of the non-eliminated groups, frozen entries included (they are cut out at the solve)."""

    offset: Mapping[VariableType, int]
    count: Mapping[VariableType, int]
    size: int
    free: BoolArray
    """(size,) which columns may move."""

    @classmethod
    def create(
        cls, state: State, free: Mapping[VariableType, BoolArray], variables: tuple[VariableType, ...]
    ) -> DenseLayout:
        """Lay the named groups out one after another."""
        offset, count, masks, size = {}, {}, [np.zeros(0, dtype=bool)], 0
        for variable in variables:
            offset[variable], count[variable] = size, len(state[variable])
            masks.append(free[variable].reshape(-1))
            size += len(state[variable]) * variable.dim
        return cls(offset, count, size, np.concatenate(masks))

    def columns(self, variable: VariableType, rows: IntArray) -> IntArray:
        """Return the columns (..., dim) of rows (...) of a variable."""
        dim = variable.dim
        result: IntArray = self.offset[variable] + rows[..., None] * dim + np.arange(dim)
        return result

    def split(self, vector: FloatArray) -> dict[VariableType, FloatArray]:
        """Cut a vector (size,) into groups (n, dim)."""
        out = {}
        for variable, start in self.offset.items():
            dim = variable.dim
            out[variable] = vector[start : start + self.count[variable] * dim].reshape(-1, dim)
        return out

    def locate(self, column: int) -> tuple[VariableType, int, int]:
        """Return the variable, row and component of a column."""
        for variable, start in self.offset.items():
            dim = variable.dim
            if start <= column < start + self.count[variable] * dim:
                return variable, (column - start) // dim, (column - start) % dim
        raise IndexError(column)
