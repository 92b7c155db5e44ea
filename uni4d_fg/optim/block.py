r"""The generic solver: any mix of variables and factors, by preconditioned conjugate gradients on sparse blocks.

The damped normal equations (J^T J + damping D) d = -J^T r have one column per free entry of whatever type. Small ones
are solved by a dense Cholesky. Large ones are solved inexactly by conjugate gradients whose products use the sparse J,
and whose preconditioner solves three parts of the matrix exactly and drops what couples them:

- the *core*, every type that is few (cameras, intrinsics, object poses, ...), as one dense block, with the points that
  the problem eliminates as its Schur complement;
- *trajectories*, types whose keys are (track, frame): the blocks of each track up to two frames apart, a band;
- all other types: the block of every variable on its own.

The claims of the fast solvers come first (:mod:`uni4d_fg.optim.backend`); what none of them takes comes here.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.block_preconditioner import BlockPreconditioner, Parts
from uni4d_fg.optim.diagnosis import undetermined_message
from uni4d_fg.optim.extension import linearize_batch
from uni4d_fg.optim.objective import SolvedPart, Step
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.threads import one_blas_thread

MOST_DENSE_COLUMNS = 12_000
"""Entries beside the eliminated points up to which a dense camera system is the better choice."""
_EXACT_COLUMNS = 1500
"""Systems up to this size are solved by a dense Cholesky."""


class BlockObjective:
    """A :class:`Problem` on variables of any types."""

    def __init__(self, problem: Problem, state: State, config: SolverConfig):
        """Plan the sparsity of J once.

        Args:
            problem: Batches and free entries.
            state: Any state of the problem; its keys tell the tracks of trajectories.
            config: Bounds of the damping diagonal, tolerance of the inner solve.
        """
        self.problem, self.config = problem, config
        self.columns: dict[VariableType, IntArray] = {}
        """Per free type the column of each entry (n, dim); -1 if frozen."""
        self.size = 0
        for variable, mask in problem.free.items():
            column = np.full(mask.shape, -1, dtype=np.int64)
            column[mask] = np.arange(self.size, self.size + int(mask.sum()))
            self.columns[variable] = column
            self.size += int(mask.sum())
        self._batches = [
            batch for batch in problem.batches if len(batch) and any(s.variable in self.columns for s in batch.slots)
        ]
        self._plan()
        self.is_exact = self.size <= _EXACT_COLUMNS
        self.parts_of_columns = None if self.is_exact else Parts.of(problem, state, self.columns)

    def _plan(self) -> None:
        """Lay J out as CSR: per batch, factor and residual the free entries of every slot."""
        columns, lengths, self._kept = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)], []
        for batch in self._batches:
            d = batch.factor_type.dim
            of_slots = [
                self.columns[s.variable][s.rows]
                if s.variable in self.columns
                else np.full((len(batch), s.variable.dim), -1)
                for s in batch.slots
            ]
            of_row = np.repeat(np.concatenate(of_slots, axis=1), d, axis=0)
            kept: BoolArray = of_row >= 0
            columns.append(of_row[kept])
            lengths.append(kept.sum(axis=1))
            self._kept.append(kept)
        self._indices = np.concatenate(columns)
        self._indptr = np.concatenate([[0], np.cumsum(np.concatenate(lengths))])

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        return self.problem.energies(state)

    def retract(self, state: State, delta: FloatArray) -> State:
        """Return ``state`` moved by a step (size,) of the free entries."""
        padded = np.append(delta, 0.0)  # a frozen entry, column -1, does not move
        return state.retract({variable: padded[column] for variable, column in self.columns.items()})

    def linearize(self, state: State) -> BlockLinearization:
        """Return the gradient and J at ``state``.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        values, residuals = [np.zeros(0)], [np.zeros(0)]
        for batch, kept in zip(self._batches, self._kept, strict=True):
            r, jacobians = linearize_batch(batch, state)
            residuals.append(r.reshape(-1))
            values.append(np.concatenate(jacobians, axis=2).reshape(kept.shape)[kept])
        shape = (len(self._indptr) - 1, self.size)
        matrix = scipy.sparse.csr_matrix((np.concatenate(values), self._indices, self._indptr), shape=shape)
        # A variable may stand in two slots of one factor: its entries add.
        matrix.sum_duplicates()
        return BlockLinearization(self, matrix, np.concatenate(residuals))

    def parts(self) -> list[SolvedPart]:
        """Return that NumPy does everything."""
        by = "NumPy dense blocks" if self.is_exact else "NumPy sparse blocks, conjugate gradients"
        return [SolvedPart(by, tuple(dict.fromkeys(b.name for b in self.problem.batches)))]

    def diagnose(self, state: State) -> str:
        """Name the variables that no factor determines."""
        diagonal = self.linearize(state).diagonal
        largest = float(diagonal.max(initial=1e-300))
        weak = []
        for variable, column in self.columns.items():
            flat = np.append(diagonal, largest)[column] <= 1e-12 * largest
            weak += [(variable, row) for row in np.flatnonzero(flat.any(axis=1)).tolist()]
        return undetermined_message(self.problem, state, weak)


class BlockLinearization:
    """J and the gradient at one point."""

    def __init__(self, objective: BlockObjective, matrix: scipy.sparse.csr_matrix, residual: FloatArray):
        self.objective, self.matrix = objective, matrix
        self._transposed = matrix.T.tocsr()
        self.gradient: FloatArray = self._transposed @ residual
        squared = matrix.copy()
        squared.data **= 2
        self.diagonal: FloatArray = np.asarray(squared.sum(axis=0)).reshape(-1)
        self._preconditioner: BlockPreconditioner | None = None

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient."""
        return float(np.abs(self.gradient).max(initial=0.0))

    def solve(self, damping: float) -> Step | None:
        """Return the step, exact or inexact, or None when a part of the system is not positive definite."""
        config = self.objective.config
        added = damping * np.clip(self.diagonal, config.min_diagonal, config.max_diagonal)
        with one_blas_thread():
            found = self._exact(added) if self.objective.is_exact else self._inexact(added)
        if found is None or not np.isfinite(found[0]).all():
            return None
        delta, iterations = found
        slope, curvature = float(self.gradient @ delta), float(np.sum((self.matrix @ delta) ** 2))
        return Step(delta, float(np.linalg.norm(delta)), max(-slope - 0.5 * curvature, 0.0), iterations)

    def _exact(self, added: FloatArray) -> tuple[FloatArray, int] | None:
        hessian = (self._transposed @ self.matrix).toarray()
        hessian[np.diag_indices(len(hessian))] += added
        try:
            factor = scipy.linalg.cho_factor(hessian, lower=True)
        except np.linalg.LinAlgError:
            return None
        result: FloatArray = -scipy.linalg.cho_solve(factor, self.gradient)
        return result, 0

    def _inexact(self, added: FloatArray) -> tuple[FloatArray, int] | None:
        config, parts = self.objective.config, self.objective.parts_of_columns
        assert parts is not None
        if self._preconditioner is None:
            self._preconditioner = BlockPreconditioner(parts, self.matrix)
        if not self._preconditioner.factorize(added):
            return None
        precondition = self._preconditioner.solve
        x, r = np.zeros_like(self.gradient), -self.gradient
        z = precondition(r)
        p, rz = z, float(r @ z)
        target, iteration = config.cg_tolerance**2 * rz, 0
        while iteration < config.cg_max_iterations and rz > target:
            product = self._transposed @ (self.matrix @ p) + added * p
            alpha = rz / float(p @ product)
            x += alpha * p
            r -= alpha * product
            z = precondition(r)
            rz, previous = float(r @ z), rz
            p = z + (rz / previous) * p
            iteration += 1
        return x, iteration
