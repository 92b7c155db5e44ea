r"""Normal equations of windows in a chain, factorized front by front.

A window ties only its own frames, and the border, which all windows may tie: the intrinsics. Neighbors share the frames
of their overlap, no others. So the window's matrix is the front of a multifrontal elimination along the chain: its
frames before the next window are eliminated,

    [ A  C^T ] [x]        W = A^{-1} C^T,     U = D - C W,
    [ C  D   ] [r],

and the update U, on the overlap and the border, is added to the next front. Backwards, with G the inverse of the whole
matrix on what a front leaves (r), that on its own columns is A^{-1} + W G W^T, and -W G between both: marginal
covariances of all frames cost little more than the factorization. Of two frames that an added factor ties over more
than a front, as a closed loop does, one is moved to the border.
Source: Duff and Reid 1983, "The multifrontal solution of indefinite sparse symmetric linear equations"; Takahashi,
Fagan and Chin 1973, "Formation of a sparse bus impedance matrix", for the inverse.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.linalg

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.slam.windows.plan import Window

NumberArray: TypeAlias = npt.NDArray[Any]
"""Real or complex."""
Entries: TypeAlias = tuple[IntArray, IntArray, NumberArray]
"""Rows, columns and values (N,) of some entries of a matrix; those of one place are summed."""

_STEP = 1e-20
"""Of the complex step: its square is nothing beside one, so the derivative has no error of difference."""


@dataclass(frozen=True)
class _Front:
    """One eliminated window."""

    own: IntArray
    """(n,) columns that it eliminates."""
    after: IntArray
    """(r,) columns that it leaves: of the overlap with the next window, and of the border."""
    factors: tuple[NumberArray, NumberArray]
    """LU of A."""
    coupling: NumberArray
    """(n, r) W."""


class FrontChain:
    """Factorization of a sum of symmetric matrices, one per window, on the free columns.

    Args:
        windows: In their order; a frame is in two at most, and only neighbors overlap.
        matrices: (n, n) per window, on ``per_frame`` columns for each of its frames and then on ``shared`` ones.
        free: (size,) columns that are not held: ``per_frame`` for each of T frames, and then the border's, of which the
            windows' shared ones are the first.
        per_frame: Columns of a frame.
        shared: Columns of the border that windows tie.
        entries: Of the matrix besides, anywhere.

    Raises:
        SolverError: If the matrix is singular.
    """

    def __init__(
        self, windows: list[Window], matrices: list[NumberArray], free: BoolArray, per_frame: int, shared: int,
        entries: Sequence[Entries] = (),
    ) -> None:  # fmt: skip
        self.per_frame, self.num_frames, self.size = per_frame, windows[-1].stop, len(free)
        starts = np.array([window.start for window in windows])
        front_of = np.searchsorted(starts, np.arange(self.num_frames), side="right") - 1
        rows, columns, values = _joined(entries, free)
        moved = self._far_frames(windows, front_of, rows, columns)
        is_border = np.ones(self.size, dtype=bool)
        is_border[: per_frame * self.num_frames] = np.repeat(moved, per_frame)
        border = np.flatnonzero(is_border & free)
        column_front = np.concatenate(
            [np.repeat(front_of, per_frame), np.zeros(self.size - len(moved) * per_frame, int)]
        )
        column_front[is_border] = len(windows)
        # Entries of the border alone may go anywhere: every front has the border.
        owner = np.minimum(column_front[rows], column_front[columns]) % len(windows)

        self.fronts: list[_Front] = []
        place, update = np.zeros(self.size, dtype=np.int64), np.zeros((0, 0))
        after = border[:0]
        for number, (window, matrix) in enumerate(zip(windows, matrices, strict=True)):
            inside = np.arange(per_frame * window.start, per_frame * window.stop)
            here = np.concatenate([inside[free[inside] & ~is_border[inside]], border])
            place[here] = np.arange(len(here))
            front = np.zeros((len(here), len(here)), matrix.dtype)
            given = np.concatenate([inside, per_frame * self.num_frames + np.arange(shared)])
            used = free[given]
            front[_block(place[given[used]])] = matrix[_block(np.flatnonzero(used))]
            mine = owner == number
            np.add.at(front, (place[rows[mine]], place[columns[mine]]), values[mine])
            front[_block(place[after])] += update
            count = int((column_front[here] == number).sum())
            factors = _factorize(front[:count, :count])
            coupling = _solve(factors, front[count:, :count].T)
            after = here[count:]
            self.fronts.append(_Front(here[:count], after, factors, coupling))
            update = front[count:, count:] - front[count:, :count] @ coupling
        self.border, self._border_factors = border, _factorize(update)

    def _far_frames(self, windows: list[Window], front_of: IntArray, rows: IntArray, columns: IntArray) -> BoolArray:
        """Return which frames (T,) to move to the border, so that no entry ties frames of no common front."""
        moved = np.zeros(self.num_frames, dtype=bool)
        inner = (rows < self.per_frame * self.num_frames) & (columns < self.per_frame * self.num_frames)
        first, second = rows[inner] // self.per_frame, columns[inner] // self.per_frame
        stops = np.array([window.stop for window in windows])
        far = second >= stops[front_of[first]]
        pairs = np.unique(np.stack([first[far], second[far]], axis=1), axis=0)
        while len(pairs):  # greedily, the frame of the most pairs first
            frame = int(np.argmax(np.bincount(pairs.reshape(-1))))
            moved[frame] = True
            pairs = pairs[(pairs != frame).all(axis=1)]
        return moved

    def solve(self, sides: FloatArray) -> FloatArray:
        """Return the solutions (m, size) of right-hand sides (m, size); zero in columns that are held."""
        x = np.zeros((self.size, len(sides)))
        for columns in (*(front.own for front in self.fronts), self.border):
            x[columns] = sides.T[columns]
        for front in self.fronts:
            x[front.after] -= front.coupling.T @ x[front.own]
        x[self.border] = _solve(self._border_factors, x[self.border])
        for front in reversed(self.fronts):
            x[front.own] = _solve(front.factors, x[front.own]) - front.coupling @ x[front.after]
        return x.T

    def real(self) -> FrontChain:
        """Return the chain of the matrix's real part, where the imaginary part is a complex step.

        The factors of a sum A + i t B have those of A as their real parts, up to the square of t.
        """
        chain = copy(self)
        chain.fronts = [replace(f, factors=_real(f.factors), coupling=f.coupling.real) for f in self.fronts]
        chain._border_factors = _real(self._border_factors)
        return chain

    def inverse_blocks(self) -> tuple[NumberArray, NumberArray]:
        """Return the inverse's blocks of every frame (T, per_frame, per_frame) and of the border (b, b).

        Columns that are held have zeros.
        """
        outer = self.size - self.per_frame * self.num_frames
        after = _solve(self._border_factors, np.eye(len(self.border)))
        frames = np.zeros((self.num_frames, self.per_frame, self.per_frame), after.dtype)
        border = np.zeros((outer, outer), after.dtype)
        last = self.border >= self.size - outer
        there = self.border[last] - (self.size - outer)
        border[np.ix_(there, there)] = after[np.ix_(last, last)]
        self._put(frames, self.border[~last], after[np.ix_(~last, ~last)])
        place = np.zeros(self.size, dtype=np.int64)
        place[self.border] = np.arange(len(self.border))
        for front in reversed(self.fronts):
            after = after[_block(place[front.after])]
            between = -front.coupling @ after
            own = _solve(front.factors, np.eye(len(front.own))) - between @ front.coupling.T
            self._put(frames, front.own, own)
            place[np.concatenate([front.own, front.after])] = np.arange(len(front.own) + len(front.after))
            after = np.block([[own, between], [between.T, after]])
        return frames, border

    def _put(self, frames: NumberArray, columns: IntArray, matrix: NumberArray) -> None:
        """Put the blocks of single frames into their places."""
        frame, column = np.divmod(columns, self.per_frame)
        i, j = np.nonzero(frame[:, None] == frame)
        frames[frame[i], column[i], column[j]] = matrix[i, j]


def stepped_chain(
    windows: list[Window], outer: list[FloatArray], inner: list[FloatArray], free: BoolArray, per_frame: int,
    shared: int, entries: Sequence[Entries] = (),
) -> FrontChain:  # fmt: skip
    """Return the factorization of a sum A, with a complex step in the direction of another, B.

    Args:
        windows: As for :class:`FrontChain`.
        outer: A's matrices.
        inner: B's.
        free: As for :class:`FrontChain`.
        per_frame: Columns of a frame.
        shared: Columns of the border that windows tie.
        entries: Of both A and B besides.

    Raises:
        SolverError: If A is singular.
    """
    matrices = [a + 1j * _STEP * b for a, b in zip(outer, inner, strict=True)]
    stepped = [(rows, columns, (1.0 + 1j * _STEP) * values) for rows, columns, values in entries]
    return FrontChain(windows, matrices, free, per_frame, shared, stepped)


def sandwich_blocks(chain: FrontChain) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return the blocks of A^{-1}, and of A^{-1} B A^{-1}, each as by :meth:`FrontChain.inverse_blocks`.

    The second is minus the derivative of (A + t B)^{-1} at t = 0, which a complex step gives to the last digits.

    Args:
        chain: As by :func:`stepped_chain`.
    """
    frames, border = chain.inverse_blocks()
    return (frames.real, border.real), (-frames.imag / _STEP, -border.imag / _STEP)


def _block(columns: IntArray) -> Any:
    """Return what selects these rows and columns of a matrix: slices where they follow each other, much the fastest."""
    if len(columns) and np.array_equal(columns, np.arange(columns[0], columns[0] + len(columns))):
        some = slice(int(columns[0]), int(columns[0]) + len(columns))
        return some, some
    return np.ix_(columns, columns)


def _joined(entries: Sequence[Entries], free: BoolArray) -> tuple[IntArray, IntArray, NumberArray]:
    """Return all entries on free columns."""
    nothing = np.zeros(0, dtype=np.int64)
    rows, columns, values = (
        np.concatenate(parts) for parts in zip(*entries, (nothing, nothing, np.zeros(0)), strict=True)
    )
    used = free[rows] & free[columns]
    return rows[used], columns[used], values[used]


def _factorize(matrix: NumberArray) -> tuple[NumberArray, NumberArray]:
    if not len(matrix):
        return matrix, np.zeros(0, dtype=np.int32)
    (getrf,) = scipy.linalg.get_lapack_funcs(("getrf",), (matrix,))
    lu, pivots, zero_pivot = getrf(matrix)
    if zero_pivot:
        raise SolverError(
            "joining windows: the windows do not determine every camera; use longer windows or a wider overlap"
        )
    return lu, pivots


def _real(factors: tuple[NumberArray, NumberArray]) -> tuple[NumberArray, NumberArray]:
    lu, pivots = factors
    return np.ascontiguousarray(lu.real), pivots


def _solve(factors: tuple[NumberArray, NumberArray], sides: NumberArray) -> NumberArray:
    if not len(factors[0]):
        return np.zeros(sides.shape, factors[0].dtype)
    result: NumberArray = scipy.linalg.lu_solve(factors, sides, check_finite=False)
    return result
