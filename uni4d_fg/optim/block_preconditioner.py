"""The preconditioner of the generic solver: parts of J^T J that are solved exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.problem import Problem

_MOST_CORE = 3000
"""Types with more free entries than this are not part of the dense core."""
_REACH = 2
"""Frames apart up to which the points of a track stay coupled."""
_CHUNK = 512
"""Points eliminated together: bounds the memory of their couplings."""


@dataclass(frozen=True)
class Parts:
    """How the columns are split."""

    core: IntArray
    """Columns of the dense block."""
    points: IntArray
    """(P, d) columns of the points that are eliminated from it; all of a point's entries are free."""
    chains: tuple[tuple[IntArray, IntArray], ...]
    """Per trajectory type the columns (n, d) of points in the order of track and frame, and their tracks (n,)."""
    single: tuple[IntArray, ...]
    """Columns of variables that are solved on their own, by number of free entries (n, k)."""

    @classmethod
    def of(cls, problem: Problem, state: State, columns: Mapping[VariableType, IntArray]) -> Parts:
        """Split the columns of a problem."""
        core: list[IntArray] = [np.zeros(0, dtype=np.int64)]
        points: IntArray = np.zeros((0, 3), dtype=np.int64)
        chains, single = [], []
        for variable, column in columns.items():
            whole = column[(column >= 0).all(axis=1)]
            free = int((column >= 0).sum())
            if (
                variable is problem.eliminated
                and len(whole) * variable.dim == free
                and _is_separable(problem, variable)
            ):
                points = whole
            elif free <= _MOST_CORE:
                core.append(column[column >= 0])
            elif len(variable.index) == 2 and len(whole) * variable.dim == free:
                numbers = state.numbers(variable)[(column >= 0).all(axis=1)]
                order = np.lexsort(numbers.T[::-1])
                chains.append((whole[order], numbers[order, 0]))
            else:
                entries = (column >= 0).sum(axis=1)
                for k in np.unique(entries[entries > 0]).tolist():
                    of_rows = column[entries == k]
                    single.append(of_rows[of_rows >= 0].reshape(-1, k))
        return cls(np.concatenate(core), points, tuple(chains), tuple(single))


def _is_separable(problem: Problem, variable: VariableType) -> bool:
    return all(sum(s.variable is variable for s in batch.slots) <= 1 for batch in problem.batches)


class BlockPreconditioner:
    """Solves the kept parts of ``J^T J + diag(added)``."""

    def __init__(self, parts: Parts, matrix: scipy.sparse.csr_matrix):
        """Form the kept blocks of J^T J.

        Args:
            parts: The split.
            matrix: J.
        """
        self.parts = parts
        by_column = matrix.tocsc()
        core = by_column[:, parts.core]
        self._core: FloatArray = (core.T @ core).toarray()
        self._points = _own_blocks(by_column, parts.points)
        flat = by_column[:, parts.points.reshape(-1)]
        self._coupling: FloatArray = (core.T @ flat).toarray().reshape(len(parts.core), *parts.points.shape)
        self._chains = [_band(by_column, columns, track) for columns, track in parts.chains]
        self._single = [_own_blocks(by_column, columns) for columns in parts.single]

    def factorize(self, added: FloatArray) -> bool:
        """Factorize with a damping diagonal (size,); return whether every part is positive definite."""
        parts = self.parts
        try:
            self._point_inverse = np.linalg.inv(np.linalg.cholesky(self._points + _diagonals(added[parts.points])))
            schur = self._core + np.diag(added[parts.core])
            for start in range(0, len(parts.points), _CHUNK):
                chunk = slice(start, start + _CHUNK)
                white = np.einsum("cpd,ped->cpe", self._coupling[:, chunk], self._point_inverse[chunk])
                white = white.reshape(len(parts.core), -1)
                schur -= white @ white.T
            self._core_factor = scipy.linalg.cho_factor(schur, lower=True) if len(schur) else None
            self._single_inverse = [
                np.linalg.inv(np.linalg.cholesky(blocks + _diagonals(added[columns])))
                for columns, blocks in zip(parts.single, self._single, strict=True)
            ]
            self._chain_factors = []
            for (columns, _), band in zip(parts.chains, self._chains, strict=True):
                damped = band.copy()
                damped[0] += added[columns].reshape(-1)
                self._chain_factors.append(scipy.linalg.cholesky_banded(damped, lower=True))
        except np.linalg.LinAlgError:
            return False
        return True

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution (size,) for a right-hand side (size,)."""
        parts, out = self.parts, np.zeros_like(right)
        inverse = self._point_inverse
        half = np.einsum("ped,pd->pe", inverse, right[parts.points])
        at_points = np.einsum("ped,pe->pd", inverse, half)
        if self._core_factor is not None:
            reduced = right[parts.core] - np.einsum("cpd,pd->c", self._coupling, at_points)
            core = scipy.linalg.cho_solve(self._core_factor, reduced)
            out[parts.core] = core
            back = np.einsum("c,cpd->pd", core, self._coupling)
            at_points -= np.einsum("ped,pe->pd", inverse, np.einsum("ped,pd->pe", inverse, back))
        out[parts.points] = at_points
        for columns, block in zip(parts.single, self._single_inverse, strict=True):
            out[columns] = np.einsum("ned,ne->nd", block, np.einsum("ned,nd->ne", block, right[columns]))
        for (columns, _), factor in zip(parts.chains, self._chain_factors, strict=True):
            solved = scipy.linalg.cho_solve_banded((factor, True), right[columns].reshape(-1))
            out[columns] = solved.reshape(columns.shape)
        return out


def _diagonals(values: FloatArray) -> FloatArray:
    """Return diagonal matrices (n, k, k) of (n, k)."""
    result: FloatArray = values[:, :, None] * np.eye(values.shape[1])
    return result


def _own_blocks(by_column: scipy.sparse.csc_matrix, columns: IntArray) -> FloatArray:
    """Return the diagonal blocks (n, k, k) of J^T J at columns (n, k)."""
    n, k = columns.shape
    blocks = np.zeros((n, k, k))
    for a in range(k):
        first = by_column[:, columns[:, a]]
        for b in range(a, k):
            product = first.multiply(by_column[:, columns[:, b]]).sum(axis=0)
            blocks[:, a, b] = blocks[:, b, a] = np.asarray(product).reshape(-1)
    return blocks


def _band(by_column: scipy.sparse.csc_matrix, columns: IntArray, track: IntArray) -> FloatArray:
    """Return the blocks of J^T J within each track, up to ``_REACH`` points apart, in LAPACK's lower form."""
    n, d = columns.shape
    chosen = by_column[:, columns.reshape(-1)]
    band = np.zeros((d * (_REACH + 1), n * d))
    for lag in range(_REACH + 1):
        together = np.flatnonzero(track[lag:] == track[: n - lag])
        for a in range(d):
            for b in range(d):
                offset = d * lag + a - b
                if offset < 0:
                    continue
                left, right = chosen[:, d * (together + lag) + a], chosen[:, d * together + b]
                band[offset, d * together + b] = np.asarray(left.multiply(right).sum(axis=0)).reshape(-1)
    return band
