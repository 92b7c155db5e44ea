"""Rows of a batch as GTSAM's custom factors, several rows to a factor.

GTSAM asks a custom factor for its error and its Jacobians one by one, through Python. The rows of a batch are therefore
evaluated together at the first question, and the others are answered from that as long as they are about the same
values.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType


@dataclass(frozen=True)
class _Point:
    """A batch evaluated at one state."""

    arrays: dict[VariableType, FloatArray]
    residual: FloatArray
    """(N, d) whitened, with the kernel in square-root form."""
    blocks: list[FloatArray]
    """Its Jacobians (N, d, dim) per slot; none if only the residual was asked for."""


class StackedFactors:
    """The rows of a batch as custom factors, several rows to a factor.

    Making a factor is a slice and a call; what its callback needs is worked out when it is called.
    """

    def __init__(self, batch: FactorBatch, state: State, stacked: bool = True):
        """Sort the rows by what they are stacked by.

        Args:
            batch: All rows.
            state: The numbers of the keys.
            stacked: Whether to stack as the factor type says; one row per factor when False.
        """
        count, slots = len(batch), batch.factor_type.stack
        stack: IntArray = np.arange(count)
        if stacked and slots is not None:
            chosen = (slots,) if isinstance(slots, int) else slots
            numbers = np.stack([state.numbers(batch.slots[i].variable)[batch.slots[i].rows, 0] for i in chosen])
            if (np.diff(numbers, axis=1) < 0).any():
                order = np.lexsort(numbers[::-1])
                batch, numbers = batch.take(order), numbers[:, order]
            stack = np.concatenate([[0], np.cumsum((np.diff(numbers, axis=1) != 0).any(axis=0))])
        self.state, self.batch = state, batch
        self._count = int(stack[-1]) + 1
        self._start: list[int] = np.searchsorted(stack, np.arange(self._count + 1)).tolist()
        self._variables = list(dict.fromkeys(slot.variable for slot in batch.slots))
        # Per variable type the distinct rows of every stack, one after another, and where each stack's begin.
        self._rows: list[IntArray] = []
        self._begin: list[list[int]] = []
        for variable in self._variables:
            rows, begin = self._distinct([s.rows for s in batch.slots if s.variable is variable], stack)
            self._rows.append(rows)
            self._begin.append(begin)
        self._last: _Point | None = None
        self._credit = self._count

    def _distinct(self, slots: list[IntArray], stack: IntArray) -> tuple[IntArray, list[int]]:
        """Return the distinct rows of every stack, ascending, and where each stack's begin."""
        first = slots[0]
        if len(slots) == 1 and (first == first[0]).all():  # one variable that all share
            return np.full(self._count, first[0]), list(range(self._count + 1))
        if len(slots) == 1 and self._count < len(stack):
            inside = np.diff(stack) == 0
            if (np.diff(first)[inside] == 0).all():  # the variable that the stacks are made by
                return first[np.array(self._start[:-1])], list(range(self._count + 1))
            if (np.diff(first)[inside] > 0).all():
                return first, self._start
        size = max(int(rows.max()) for rows in slots) + 1
        pairs = np.unique(np.concatenate([stack * size + rows for rows in slots]))
        begin: list[int] = np.searchsorted(pairs // size, np.arange(self._count + 1)).tolist()
        return pairs % size, begin

    def factors(self) -> Iterator[gtsam.CustomFactor]:
        """Yield the factors."""
        dim = self.batch.factor_type.dim
        keys = [
            np.array(self.state.keys(variable), dtype=np.uint64)[rows].tolist()
            for variable, rows in zip(self._variables, self._rows, strict=True)
        ]
        noise: dict[int, Any] = {}
        for i in range(self._count):
            size = dim * (self._start[i + 1] - self._start[i])
            if size not in noise:
                noise[size] = gtsam.noiseModel.Unit.Create(size)
            own: list[int] = []
            for k, b in zip(keys, self._begin, strict=True):
                own += k[b[i] : b[i + 1]]
            yield gtsam.CustomFactor(noise[size], own, _Callback(self, i))

    def error(self, index: int, keys: list[int], values: gtsam.Values, jacobians: Any) -> FloatArray:
        """Return the stacked whitened residual of a factor and write its Jacobians."""
        own = slice(self._start[index], self._start[index + 1])
        current, first = [], 0
        for variable, begin in zip(self._variables, self._begin, strict=True):
            count = begin[index + 1] - begin[index]
            current.append([variable.from_gtsam(values, key) for key in keys[first : first + count]])
            first += count
        point = self._point(index, current, values, jacobians is not None)
        if jacobians is None:
            return point.residual[own].reshape(-1)
        r = point.residual[own]
        count, d = r.shape
        row, entry = np.arange(count)[:, None, None], np.arange(d)[:, None]
        first = 0
        for variable, rows, begin, columns in zip(self._variables, self._rows, self._begin, self._columns, strict=True):
            mine = rows[begin[index] : begin[index + 1]]
            stacked = np.zeros((len(mine), count, d, variable.gtsam_dim or variable.dim))
            for slot, block in zip(self.batch.slots, point.blocks, strict=True):
                if slot.variable is variable:  # it may stand in two slots of one factor: add
                    at = np.searchsorted(mine, slot.rows[own])
                    stacked[at[:, None, None], row, entry, columns] += block[own]
            for i, jacobian in enumerate(stacked):
                jacobians[first + i] = np.asfortranarray(jacobian.reshape(count * d, -1))
            first += len(mine)
        return r.reshape(-1)

    def _point(self, index: int, current: list[list[FloatArray]], values: gtsam.Values, blocks: bool) -> _Point:
        """Return residuals, and Jacobians if asked for, at a factor's values; other rows may be of elsewhere.

        GTSAM asks for one factor after another at the same values, so that all rows are evaluated at once. A caller
        who asks for one factor at ever other values has it evaluated alone, but for every so many calls.
        """
        self._credit = min(self._credit + 2, 4 * self._count)
        point = self._last
        if point is not None and (not blocks or point.blocks):
            found = point.arrays
            if all(
                np.array_equal(found[variable][rows[begin[index] : begin[index + 1]]], mine)
                for variable, rows, begin, mine in zip(self._variables, self._rows, self._begin, current, strict=True)
            ):
                return point
        base = self.state.arrays if point is None else point.arrays
        arrays = {variable: base[variable].copy() for variable in self._variables}
        for variable, rows, begin, mine in zip(self._variables, self._rows, self._begin, current, strict=True):
            arrays[variable][rows[begin[index] : begin[index + 1]]] = mine
        own = slice(self._start[index], self._start[index + 1])
        if self._credit < self._count:
            return self._evaluated(arrays, blocks, own)
        self._credit -= self._count
        for variable, places in self._places.items():
            for row, key in places:
                if values.exists(key):
                    arrays[variable][row] = variable.from_gtsam(values, key)
        try:
            self._last = self._evaluated(arrays, blocks, slice(None))
        except SolverError:  # perhaps of another factor
            return self._evaluated(arrays, blocks, own)
        return self._last

    def _evaluated(self, arrays: dict[VariableType, FloatArray], blocks: bool, rows: slice) -> _Point:
        """Evaluate some rows; the others are zero.

        Raises:
            SolverError: If a shape is wrong or a value is not finite, which GTSAM would accept.
        """
        batch = self.batch.take(np.arange(len(self.batch))[rows])
        arguments = [arrays[slot.variable][slot.rows] for slot in batch.slots]
        jacobians: list[FloatArray] = []
        if blocks:
            r, jacobians = batch.factor_type.linearize(*arguments, **batch.data)
            batch.check(r, jacobians, self.state)
        else:
            r = np.asarray(batch.factor_type.residual(*arguments, **batch.data))
        r, jacobians = _robust_square_root(batch, r, jacobians)
        if len(batch) == len(self.batch):
            return _Point(arrays, r, jacobians)
        full = [np.zeros((len(self.batch), *array.shape[1:])) for array in (r, *jacobians)]
        for whole, part in zip(full, (r, *jacobians), strict=True):
            whole[rows] = part
        return _Point(arrays, full[0], full[1:])

    @cached_property
    def _places(self) -> dict[VariableType, list[tuple[int, int]]]:
        """Per variable type the row and key of every variable that a factor reads."""
        out = {}
        for variable, rows in zip(self._variables, self._rows, strict=True):
            distinct = np.unique(rows)
            keys = variable.keys(self.state.numbers(variable)[distinct])
            out[variable] = list(zip(distinct.tolist(), keys, strict=True))
        return out

    @cached_property
    def _columns(self) -> list[IntArray]:
        """Per variable type where the entries of its tangent stand in GTSAM's."""
        return [np.array(list(v.gtsam_columns) or range(v.dim)) for v in self._variables]


class _Callback:
    """What GTSAM calls for one stacked factor."""

    __slots__ = ("index", "owner")

    def __init__(self, owner: StackedFactors, index: int):
        self.owner, self.index = owner, index

    def __call__(self, this: Any, values: gtsam.Values, jacobians: Any) -> FloatArray:
        return self.owner.error(self.index, list(this.keys()), values, jacobians)


def _robust_square_root(
    batch: FactorBatch, r: FloatArray, blocks: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return a(s) r and its exact Jacobians, with |a r|^2 / 2 = weight rho(s)."""
    inverse_sigma = 1.0 / (batch.sigma[:, None] if batch.sigma.ndim == 1 else batch.sigma)
    white = r * inverse_sigma
    a, slope = batch.kernel.square_root(np.einsum("nd,nd->n", white, white))
    root_weight = np.sqrt(batch.weight)
    out = []
    for block in blocks:
        white_block = block * inverse_sigma[:, :, None]
        radial = np.einsum("nd,ndk->nk", white, white_block)
        full = a[:, None, None] * white_block + (slope[:, None] * white)[:, :, None] * radial[:, None, :]
        out.append(root_weight[:, None, None] * full)
    return (root_weight * a)[:, None] * white, out
