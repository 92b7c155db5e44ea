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

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.factor_type import NativeRow
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stacked_factors import StackedFactors

HELD_SIGMA = 1e-8
"""Sigma of a frozen entry, in the entry's unit: a gradient g there moves it by g 1e-16 and saves half of g^2 1e-16."""
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
