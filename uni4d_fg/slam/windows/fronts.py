r"""Normal equations of windows in a chain, factorized front by front.

A window ties only its own frames, and the border, which all windows may tie: the intrinsics. Neighbors share the frames
of their overlap, no others. So the window's matrix is the front of a multifrontal elimination along the chain: its
frames before the next window are eliminated,

    [ A  C^T ] [x]        W = A^{-1} C^T,     U = D - C W,
    [ C  D   ] [r],

and the update U, on the overlap and the border, is added to the next front. Backwards, with G the inverse of the whole
matrix on what a front leaves (r), that on its own columns is A^{-1} + W G W^T, and -W G between both: marginal
covariances of all frames cost little more than the factorization.
Source: Duff and Reid 1983, "The multifrontal solution of indefinite sparse symmetric linear equations"; Takahashi,
Fagan and Chin 1973, "Formation of a sparse bus impedance matrix", for the inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.linalg

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.slam.windows.information import UNDETERMINED
from uni4d_fg.slam.windows.plan import Window

NumberArray: TypeAlias = npt.NDArray[Any]
"""Real or complex."""

_STEP = 1e-20
"""Of the complex step: its square is nothing beside one, so the derivative has no error of difference."""


@dataclass(frozen=True)
class _Front:
    """One eliminated window."""

    start: int
    """Place of its first column among the free ones."""
    after: IntArray
    """(r,) places of the columns that it leaves: the overlap with the next window, and the border."""
    factors: tuple[NumberArray, NumberArray]
    """LU of A."""
    coupling: NumberArray
    """(n, r) W."""

    @property
    def own(self) -> slice:
        """Places of the columns that it eliminates."""
        return slice(self.start, self.start + len(self.coupling))

    def solve(self, sides: NumberArray) -> NumberArray:
        """Return A^{-1} times (n, m)."""
        result: NumberArray = scipy.linalg.lu_solve(self.factors, sides, check_finite=False)
        return result


class FrontChain:
    """Factorization of a sum of symmetric matrices, one per window, on the free columns.

    Args:
        windows: In their order; a frame is in two at most, and only neighbors overlap.
        matrices: (n, n) per window, on ``per_frame`` columns for each of its frames and then the border's.
        free: (per_frame T + border,) columns that are not held.
        per_frame: Columns of a frame.

    Raises:
        SolverError: If the matrix is singular.
    """

    def __init__(self, windows: list[Window], matrices: list[NumberArray], free: BoolArray, per_frame: int) -> None:
        self.free, self.per_frame, self.num_frames = free, per_frame, windows[-1].stop
        place = np.cumsum(free) - 1
        border = np.arange(per_frame * self.num_frames, len(free))
        self.fronts: list[_Front] = []
        update, into = np.zeros((0, 0)), np.zeros(0, dtype=np.int64)
        for window, following, matrix in zip(windows, [*windows[1:], None], matrices, strict=True):
            columns = np.concatenate([np.arange(per_frame * window.start, per_frame * window.stop), border])
            here = free[columns]
            front, at = matrix[np.ix_(here, here)], place[columns[here]]
            where = np.searchsorted(at, into)
            front[np.ix_(where, where)] += update
            end = window.stop if following is None else following.start
            count = int(free[per_frame * window.start : per_frame * end].sum())
            factors = _factorize(front[:count, :count])
            coupling = scipy.linalg.lu_solve(factors, front[count:, :count].T, check_finite=False)
            into = at[count:]
            self.fronts.append(_Front(int(at[0]), into, factors, coupling))
            update = front[count:, count:] - front[count:, :count] @ coupling
        self.border = into
        self._border_factors = _factorize(update) if len(into) else None

    def solve(self, sides: FloatArray) -> FloatArray:
        """Return the solutions (m, size) of right-hand sides (m, size); zero in columns that are held."""
        x = np.ascontiguousarray(sides[:, self.free].T)
        for front in self.fronts:
            x[front.after] -= front.coupling.T @ x[front.own]
        if self._border_factors is not None:
            x[self.border] = scipy.linalg.lu_solve(self._border_factors, x[self.border], check_finite=False)
        for front in reversed(self.fronts):
            x[front.own] = front.solve(x[front.own]) - front.coupling @ x[front.after]
        solved = np.zeros_like(sides)
        solved[:, self.free] = x.T
        return solved

    def inverse_blocks(self) -> tuple[NumberArray, NumberArray]:
        """Return the inverse's blocks of every frame (T, per_frame, per_frame) and of the border (b, b).

        Columns that are held have zeros.
        """
        kind = self.fronts[0].coupling.dtype
        frames = np.zeros((self.num_frames, self.per_frame, self.per_frame), kind)
        border_free = self.free[self.per_frame * self.num_frames :]
        border = np.zeros((len(border_free), len(border_free)), kind)
        places = np.flatnonzero(self.free)
        after: NumberArray = np.zeros((0, 0), kind)
        if self._border_factors is not None:
            after = scipy.linalg.lu_solve(self._border_factors, np.eye(len(self.border)), check_finite=False)
            border[np.ix_(border_free, border_free)] = after
        known = self.border
        for front in reversed(self.fronts):
            kept = np.searchsorted(known, front.after)
            after = after[np.ix_(kept, kept)]
            between = -front.coupling @ after
            own = front.solve(np.eye(len(front.coupling))) - between @ front.coupling.T
            frame, column = np.divmod(places[front.own], self.per_frame)
            spread = np.zeros((frame[-1] - frame[0] + 1, self.per_frame) * 2, kind)
            row = frame - frame[0], column
            spread[row[0][:, None], row[1][:, None], row[0], row[1]] = own
            number = np.arange(len(spread))
            frames[frame[0] : frame[-1] + 1] = spread[number, :, number]
            known = np.concatenate([np.arange(front.own.start, front.own.stop), front.after])
            after = np.block([[own, between], [between.T, after]])
        return frames, border


def sandwich_blocks(
    windows: list[Window], outer: list[FloatArray], inner: list[FloatArray], free: BoolArray, per_frame: int
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return the blocks of A^{-1}, and of A^{-1} B A^{-1}, for sums A and B over windows.

    The second is minus the derivative of (A + t B)^{-1} at t = 0, which a complex step gives to the last digits.

    Args:
        windows: As for :class:`FrontChain`.
        outer: A's matrices.
        inner: B's.
        free: As for :class:`FrontChain`.
        per_frame: Columns of a frame.

    Returns:
        Each as by :meth:`FrontChain.inverse_blocks`.

    Raises:
        SolverError: If A is singular.
    """
    matrices = [a + 1j * _STEP * b for a, b in zip(outer, inner, strict=True)]
    frames, border = FrontChain(windows, matrices, free, per_frame).inverse_blocks()
    return (frames.real, border.real), (-frames.imag / _STEP, -border.imag / _STEP)


def _factorize(matrix: NumberArray) -> tuple[NumberArray, NumberArray]:
    (getrf,) = scipy.linalg.get_lapack_funcs(("getrf",), (matrix,))
    lu, pivots, zero_pivot = getrf(matrix)
    if zero_pivot:
        raise SolverError(UNDETERMINED)
    return lu, pivots
