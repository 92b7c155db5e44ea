"""Blocks of J^T J that couple points of one track, gathered into one symmetric banded matrix.

Points are ordered by track and frame, so that a point and its track's next two lie within nine diagonals.
Which products fall on which diagonal is planned once: summing them is then one sparse product with a matrix
of ones per entry of a 3x3 block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray

REACH = 2
"""Rows apart up to which two points of a track are coupled (second differences need 2)."""
BANDS = 3 * REACH + 3
"""Stored diagonals: the main one and those below it."""


@dataclass(frozen=True)
class _Pair:
    """Two slots whose points are of one track and a fixed number of rows apart."""

    first: int
    second: int
    rows: IntArray | None
    """Factors for which that holds; None for all of them."""
    start: int
    stop: int
    """Where their products stand in the buffer that is summed."""


@dataclass(frozen=True)
class _Lag:
    """The pairs a fixed number of rows apart, and the matrix (points, products) that sums their products."""

    lag: int
    pairs: tuple[_Pair, ...]
    total: scipy.sparse.csr_matrix


def within_reach(rows: list[IntArray], track: IntArray) -> BoolArray:
    """Return which factors read points of one track only, at most ``REACH`` rows apart: (N,)."""
    stacked = np.stack(rows)
    same_track = (track[stacked] == track[stacked[0]]).all(axis=0)
    return np.asarray(same_track & (np.ptp(stacked, axis=0) <= REACH))


class BandAssembler:
    """Adds the part of one factor batch to the gradient and to the banded matrix."""

    def __init__(self, rows: list[IntArray], track: IntArray):
        """Plan where products go.

        Args:
            rows: Per slot (N,) the point each factor reads.
            track: (P,) track of every point; points of one track are consecutive.
        """
        self._point_sum = _summing(np.concatenate(rows), len(track))
        # A factor that couples a track beyond the reach keeps the blocks of single points only: leaving out some of
        # its other blocks could make the sum indefinite.
        complete = np.ones(len(rows[0]), dtype=bool)
        for p in rows:
            for q in rows:
                complete &= (track[p] != track[q]) | (np.abs(p - q) <= REACH)
        self._lags = [lag for i in range(REACH + 1) if (lag := _plan_lag(i, rows, track, complete)) is not None]

    def add_gradient(self, components: list[FloatArray], residual: FloatArray, gradient: FloatArray) -> None:
        """Add J^T r to ``gradient`` (3 P,): Jacobians (d, 3, N) per slot, residual (d, N)."""
        count = residual.shape[1]
        products = np.empty(count * len(components))
        for a in range(3):
            for slot, component in enumerate(components):
                _contract(component[:, a], residual, products[slot * count : (slot + 1) * count])
            gradient[a::3] += self._point_sum @ products

    def add_bands(self, components: list[FloatArray], bands: FloatArray) -> None:
        """Add the blocks of J^T J to ``bands`` (BANDS, 3 P), LAPACK's lower form: Jacobians (d, 3, N) per slot."""
        for plan in self._lags:
            products = np.empty(plan.pairs[-1].stop)
            chosen = [_choose(components, pair) for pair in plan.pairs]
            for a in range(3):
                for b in range(3 if plan.lag else a + 1):
                    for pair, (first, second) in zip(plan.pairs, chosen, strict=True):
                        _contract(first[:, a], second[:, b], products[pair.start : pair.stop])
                    bands[3 * plan.lag + a - b, b::3] += plan.total @ products


def _contract(first: FloatArray, second: FloatArray, out: FloatArray) -> None:
    """Write the sum over the first axis of ``first * second`` to ``out``."""
    np.multiply(first[0], second[0], out=out)
    for row in range(1, len(first)):
        out += first[row] * second[row]


def symmetric(bands: FloatArray) -> scipy.sparse.dia_matrix:
    """Return the symmetric matrix of ``bands`` (BANDS, n), both triangles stored."""
    count, n = bands.shape
    data = np.zeros((2 * count - 1, n))
    data[:count] = bands
    for d in range(1, min(count, n)):
        data[count - 1 + d, d:] = bands[d, :-d]
    offsets = np.concatenate([-np.arange(count), np.arange(1, count)])
    return scipy.sparse.dia_matrix((data, offsets), shape=(n, n))


def _choose(components: list[FloatArray], pair: _Pair) -> tuple[FloatArray, FloatArray]:
    first, second = components[pair.first], components[pair.second]
    return (first, second) if pair.rows is None else (first[:, :, pair.rows], second[:, :, pair.rows])


def _plan_lag(lag: int, rows: list[IntArray], track: IntArray, complete: BoolArray) -> _Lag | None:
    pairs, points, start = [], [], 0
    for i, p in enumerate(rows):
        for j, q in enumerate(rows):
            taken = np.asarray((track[p] == track[q]) & (p - q == lag) & (complete | (lag == 0)))
            count = int(taken.sum())
            if count == 0:
                continue
            some = None if count == len(p) else np.flatnonzero(taken)
            pairs.append(_Pair(i, j, some, start, start + count))
            points.append(q if some is None else q[some])
            start += count
    return _Lag(lag, tuple(pairs), _summing(np.concatenate(points), len(track))) if pairs else None


def _summing(points: IntArray, count: int) -> scipy.sparse.csr_matrix:
    """Return the 0/1 matrix (count, len(points)) that sums values by point."""
    order = np.argsort(points, kind="stable").astype(np.int32)
    start = np.searchsorted(points[order], np.arange(count + 1)).astype(np.int32)
    return scipy.sparse.csr_matrix((np.ones(len(points)), order, start), shape=(count, len(points)))
