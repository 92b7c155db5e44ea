"""The values of all variables, as one array per type, and their retraction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.variable import VariableType, locate

Delta = Mapping[VariableType, FloatArray]
"""Tangent step per variable type: (n, dim)."""


@dataclass(frozen=True)
class State:
    """Values of every variable of a problem. Immutable: :meth:`retract` returns a new state.

    Row i of a type's array is the variable whose key has the numbers ``index[type][i]``.

    Raises:
        SolverError: Where a type is asked for that the state does not have, or has in another declaration.
    """

    arrays: Mapping[VariableType, FloatArray]
    """Values per type, (n, \\*shape)."""
    index: Mapping[VariableType, IntArray] = field(default_factory=dict)
    """Numbers of the keys per type, (n,) or (n, k); the row number (and frame 0) where a type is absent."""

    def __getitem__(self, variable: VariableType) -> FloatArray:
        try:
            return self.arrays[variable]
        except KeyError:
            raise SolverError(self._missing(variable)) from None

    def __contains__(self, variable: object) -> bool:
        return variable in self.arrays

    def replace(self, arrays: Mapping[VariableType, FloatArray]) -> State:
        """Return a state in which the given types have new values, under the same keys."""
        return State({**self.arrays, **arrays}, self.index)

    def retract(self, delta: Delta) -> State:
        """Move every type along its tangent step; types without one stay as they are (not copied)."""
        moved = dict(self.arrays)
        for variable, step in delta.items():
            moved[variable] = variable.manifold.retract(self.arrays[variable], step)
        return State(moved, self.index)

    def numbers(self, variable: VariableType) -> IntArray:
        """Return the numbers of the keys of a type, (n, len(variable.index))."""
        count, width = len(self.arrays[variable]), len(variable.index)
        found = self.index.get(variable)
        if found is not None:
            return np.asarray(found, dtype=np.int64).reshape(count, width)
        out = np.zeros((count, width), dtype=np.int64)
        out[:, 0] = np.arange(count)
        return out

    def keys(self, variable: VariableType) -> list[int]:
        """Return the GTSAM key of every row of a type."""
        return variable.keys(self.numbers(variable))

    def key(self, variable: VariableType, row: int) -> int:
        """Return the GTSAM key of one row of a type."""
        return variable.keys(self.numbers(variable)[row : row + 1])[0]

    def describe(self, variable: VariableType, row: int) -> str:
        """Return words for one row of a type: "landmark, track 17"."""
        return variable.describe(*self.numbers(variable)[row].tolist())

    def rows_of(self, keys: list[int]) -> list[tuple[VariableType, int]]:
        """Return the type and row of every key.

        Raises:
            KeyError: If the state has no variable with one of the keys.
            SolverError: If it has those of another declaration of the type.
        """
        place: dict[VariableType, dict[int, int]] = {}
        out = []
        for key in keys:
            found = locate(key)
            if found is None:
                raise KeyError(key)
            variable = found[0]
            if variable not in self.arrays:
                if any(held.name == variable.name for held in self.arrays):
                    raise SolverError(self._missing(variable))
                raise KeyError(key)
            if variable not in place:
                place[variable] = {k: row for row, k in enumerate(self.keys(variable))}
            out.append((variable, place[variable][key]))
        return out

    def to_values(self, rows: Mapping[VariableType, BoolArray] | None = None) -> gtsam.Values:
        """Copy into a ``gtsam.Values``, each variable as its type says (Pose3, Cal3_S2, Point3, ...).

        Args:
            rows: Rows to copy per type, (n,) bool; every row of every type when None.
        """
        values = gtsam.Values()
        for variable, array in self.arrays.items():
            if rows is not None and variable not in rows:
                continue
            chosen = np.arange(len(array)) if rows is None else np.flatnonzero(rows[variable])
            keys, to_gtsam = variable.keys(self.numbers(variable)[chosen]), variable.to_gtsam
            for key, row in zip(keys, chosen.tolist(), strict=True):
                values.insert(key, to_gtsam(array[row]))
        return values

    def with_values(self, values: gtsam.Values) -> State:
        """Return this state with every row that ``values`` holds taken from there."""
        moved = {}
        for variable, array in self.arrays.items():
            out = array.copy()
            for row, key in enumerate(self.keys(variable)):
                if values.exists(key):
                    out[row] = variable.from_gtsam(values, key)
            moved[variable] = out
        return State(moved, self.index)

    def _missing(self, variable: VariableType) -> str:
        """Return what to say of a type that is not here."""
        if any(held.name == variable.name for held in self.arrays):
            return (
                f"variable type '{variable}' was declared twice, and this state and what reads it hold different "
                "declarations; make both anew after the last one"
            )
        return f"the state has no {variable} variables, only {', '.join(map(str, self.arrays)) or 'none at all'}"

    @classmethod
    def from_values(cls, values: gtsam.Values) -> State:
        """Return a state of every variable of a ``gtsam.Values`` whose key character is declared.

        Raises:
            ValueError: If a key is of no declared type.
        """
        arrays: dict[VariableType, list[FloatArray]] = {}
        numbers: dict[VariableType, list[tuple[int, ...]]] = {}
        for key in values.keys():  # noqa: SIM118 - not a dictionary
            found = locate(key)
            if found is None:
                raise ValueError(f"key {key} ({gtsam.DefaultKeyFormatter(key)}) is of no declared variable type")
            arrays.setdefault(found[0], []).append(found[0].from_gtsam(values, key))
            numbers.setdefault(found[0], []).append(found[1])
        return cls(
            {variable: np.stack(rows) for variable, rows in arrays.items()},
            {variable: np.array(rows, dtype=np.int64) for variable, rows in numbers.items()},
        )
