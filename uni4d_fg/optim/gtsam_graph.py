"""A problem as a GTSAM factor graph, and back.

    graph, values = to_gtsam(problem, state)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    state = state.with_values(result)

Variables are GTSAM's own types (``Pose3``, ``Point3``, ``Cal3_S2``, ...) under the keys of their declarations. Where
GTSAM has a factor that equals ours it is used, with sigma, weight and robust kernel in its noise model; every other
factor is a ``gtsam.CustomFactor``, of one row or stacked (all observations of a landmark in one). What is frozen is a
variable that a tight prior holds, so that ``graph.error(values)`` is the problem's energy and every factor can be
looked at.

A stacked factor carries the robust kernel of each of its rows in square-root form, because GTSAM's robust noise models
see a stacked residual as one. Inside GTSAM's own optimizers each callback of a custom factor copies the whole
``Values``: cost is quadratic in the number of variables. Our driver linearizes on a ``Values`` that Python holds, where
it is linear.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.factor_type import NativeRow
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.problem import Problem

HELD_SIGMA = 1e-6
"""Sigma of a frozen entry, in the entry's unit."""
_LOOSE_SIGMA = 1e9
"""Sigma of an entry that a prior leaves alone."""
_NATIVE_KERNELS = ("quadratic", "huber", "cauchy")


def to_gtsam(
    problem: Problem, state: State, *, native: bool = True, stacked: bool = True
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return a problem as GTSAM's graph and values.

    Args:
        problem: Factors and free entries.
        state: Values, and the numbers of the keys.
        native: Use GTSAM's own factors where they equal ours; custom factors only when False.
        stacked: Collect custom factors as their types say; one per row when False.

    Returns:
        The graph, whose error at the values is the problem's energy, and the values of all variables that it reads.
        Behind the camera GTSAM's projection factors differ: their error has no gradient there.
    """
    graph = gtsam.NonlinearFactorGraph()
    for batch in problem.batches:
        for item in gtsam_factors(batch, state, native=native, stacked=stacked):
            graph.push_back(item)
    read = variables_read(problem, state)
    for variable, held in held_variables(problem, state, read):
        graph.push_back(held.prior(variable))
    return graph, state.to_values(read)


def variables_read(problem: Problem, state: State) -> dict[VariableType, Any]:
    """Return per variable type the rows (n,) that a factor with a weight reads."""
    read: dict[VariableType, Any] = {}
    for batch in problem.batches:
        counts = batch.weight > 0
        for slot in batch.slots:
            mask = read.setdefault(slot.variable, np.zeros(len(state[slot.variable]), dtype=bool))
            mask[slot.rows if counts.all() else slot.rows[counts]] = True
    return read


def gtsam_factors(batch: FactorBatch, state: State, *, native: bool = True, stacked: bool = True) -> Iterator[Any]:
    """Yield a batch as GTSAM factors; rows of weight zero are left out."""
    if not (batch.weight > 0).all():
        batch = batch.take(np.flatnonzero(batch.weight > 0))
    if native and (made := _native_factors(batch, state)):
        yield from (item for item in made if item is not None)
        batch = batch.take(np.array([row for row, item in enumerate(made) if item is None], dtype=np.int64))
    if len(batch):
        yield from StackedFactors(batch, state, stacked).factors()


def row_factors(batch: FactorBatch, state: State) -> list[Any]:
    """Return one factor per row (n,), GTSAM's own where it equals ours; the rows have weights above zero."""
    made = _native_factors(batch, state) or [None] * len(batch)
    left = np.array([row for row, item in enumerate(made) if item is None], dtype=np.int64)
    if len(left):
        for row, item in zip(left.tolist(), StackedFactors(batch.take(left), state, False).factors(), strict=True):
            made[row] = item
    return made


def _native_factors(batch: FactorBatch, state: State) -> list[Any]:
    """Return GTSAM's own factor per row, None where it has none that is equal; nothing where it never has."""
    make = batch.factor_type.native
    if make is None or batch.kernel.kind not in _NATIVE_KERNELS:
        return []
    keys = [state.keys(slot.variable) for slot in batch.slots]
    made = []
    for row in range(len(batch)):
        places = [int(slot.rows[row]) for slot in batch.slots]
        made.append(
            make(
                NativeRow(
                    tuple(of_slot[place] for of_slot, place in zip(keys, places, strict=True)),
                    tuple(state[s.variable][place] for s, place in zip(batch.slots, places, strict=True)),
                    {name: array[row] for name, array in batch.data.items()},
                    _noise(batch, row),
                    batch.kernel.kind != "quadratic",
                )
            )
        )
    return made


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
        batch = self.batch.take(np.arange(self._start[index], self._start[index + 1]))
        rows_of, offset_of, first = {}, {}, 0
        for variable, rows, begin in zip(self._variables, self._rows, self._begin, strict=True):
            rows_of[variable] = rows[begin[index] : begin[index + 1]]
            offset_of[variable] = first
            first += len(rows_of[variable])
        current = {
            variable: np.stack([variable.from_gtsam(values, key) for key in keys[offset_of[variable] :][: len(rows)]])
            for variable, rows in rows_of.items()
        }
        place = [np.searchsorted(rows_of[slot.variable], slot.rows) for slot in batch.slots]
        arguments = [current[slot.variable][at] for slot, at in zip(batch.slots, place, strict=True)]
        if jacobians is None:
            r, _ = _robust_square_root(batch, np.asarray(batch.factor_type.residual(*arguments, **batch.data)), [])
            return r.reshape(-1)
        r, blocks = batch.factor_type.linearize(*arguments, **batch.data)
        batch.check(r, blocks, self.state)  # GTSAM would accept a wrong shape and a NaN
        r, blocks = _robust_square_root(batch, r, blocks)
        count, d = r.shape
        for variable, rows in rows_of.items():
            width = variable.gtsam_dim or variable.dim
            columns = list(variable.gtsam_columns) or list(range(variable.dim))
            stacked = np.zeros((len(rows), count, d, width))
            for slot, at, block in zip(batch.slots, place, blocks, strict=True):
                if slot.variable is variable:
                    for n, row in enumerate(at.tolist()):  # a variable may stand in two slots of one factor: add
                        stacked[row, n][:, columns] += block[n]
            for i in range(len(rows)):
                jacobians[offset_of[variable] + i] = np.asfortranarray(stacked[i].reshape(count * d, width))
        return r.reshape(-1)


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


@dataclass(frozen=True)
class Held:
    """A variable of which some entries are frozen."""

    key: int
    value: FloatArray
    sigma: FloatArray
    """Of its prior, in GTSAM's tangent."""

    @property
    def is_whole(self) -> bool:
        """Whether nothing of it may move."""
        return bool((self.sigma == HELD_SIGMA).all())

    def prior(self, variable: VariableType) -> Any:
        """Return the prior that holds it."""
        return _prior(self.key, variable.to_gtsam(self.value), gtsam.noiseModel.Diagonal.Sigmas(self.sigma))


def held_variables(
    problem: Problem, state: State, read: Mapping[VariableType, Any]
) -> Iterator[tuple[VariableType, Held]]:
    """Yield what is frozen, and what of GTSAM's tangents ours do not have (skew), among the rows that are read."""
    for variable, rows in read.items():
        free = problem.free.get(variable)
        width = variable.gtsam_dim or variable.dim
        columns = list(variable.gtsam_columns) or list(range(variable.dim))
        chosen = np.flatnonzero(rows)
        if free is not None and width == variable.dim:
            chosen = chosen[~free[chosen].all(axis=1)]  # the usual case: nothing to hold
        for row, key in zip(chosen.tolist(), variable.keys(state.numbers(variable)[chosen]), strict=True):
            sigma = np.full(width, HELD_SIGMA)
            if free is not None:
                sigma[columns] = np.where(free[row], _LOOSE_SIGMA, HELD_SIGMA)
            if not (sigma == _LOOSE_SIGMA).all():
                yield variable, Held(key, state[variable][row], sigma)


def _prior(key: int, value: Any, noise: Any) -> Any:
    """Return GTSAM's prior on a value of any of its types."""
    name = "Vector" if isinstance(value, np.ndarray) else type(value).__name__
    if isinstance(value, np.ndarray) and value.shape == (3,):
        name = "Point3"
    return getattr(gtsam, f"PriorFactor{name}")(key, value, noise)


def _noise(batch: FactorBatch, row: int) -> gtsam.noiseModel.Base:
    """Return the noise and kernel of one row; w rho_c(s) = rho_{c sqrt(w)}(s sqrt(w)) for these kernels."""
    sigma = np.broadcast_to(batch.sigma[row] / np.sqrt(batch.weight[row]), (batch.factor_type.dim,))
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
    if batch.kernel.kind == "quadratic":
        return noise
    threshold = float(batch.kernel.threshold * np.sqrt(batch.weight[row]))
    estimator = gtsam.noiseModel.mEstimator
    kernel = estimator.Huber(threshold) if batch.kernel.kind == "huber" else estimator.Cauchy(threshold)
    return gtsam.noiseModel.Robust.Create(kernel, noise)
