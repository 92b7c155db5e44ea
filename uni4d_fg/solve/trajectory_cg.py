r"""Inexact Gauss-Newton for many trajectories of points: conjugate gradients with a banded preconditioner.

The unknowns of non-rigid bundle adjustment form a mesh in (track, time): temporal smoothness couples a
track with itself, as-rigid-as-possible couples tracks. Direct elimination fills in and grows faster than
linearly. Here the damped normal equations (J^T J + damping D) d = -J^T r are solved by conjugate gradients
that only ever multiply by the sparse J and J^T. The preconditioner is the exact block of every track on its
own - all of its time steps with each other up to two frames apart - which is a banded matrix with nine
diagonals when points are ordered by track and time, factored by one banded Cholesky. What it leaves
out is the coupling between tracks, so that few steps are needed, and each costs time linear in the number
of factors. The inner solve is inexact (Nash and Sofer's relative-residual rule).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.graph.keys import decode
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import State
from uni4d_fg.solve.objective import Step

_REACH = 2
"""Frames apart up to which a track's own coupling is in the preconditioner (second differences need 2)."""
_BANDS = 3 * _REACH + 3


@dataclass(frozen=True)
class _BandPlan:
    """Where the products of two slots of a batch fall in the banded matrix."""

    first: int
    second: int
    rows: IntArray
    """Factors whose two variables are of one track and at most ``_REACH`` rows apart, second <= first."""
    target: IntArray
    """(rows, 3, 3) flat position in the (bands, size) array; -1 above the diagonal."""


class TrajectoryObjective:
    """A :class:`Problem` on one group of points ordered by track and frame, all of them free."""

    def __init__(self, problem: Problem, state: State, config: SolverConfig, group: str = "dynamic_point"):
        """Plan the sparsity of J and of the preconditioner once.

        Args:
            problem: Batches that read rows of ``group`` only.
            state: State whose ``names.dynamic_track_frame`` gives the track of each row; rows of one track
                must be consecutive and in the order of their frames.
            config: Tolerance of the inner solve and bounds of the damping diagonal.
            group: The point group.
        """
        self.problem, self.config, self.group = problem, config, group
        self.size = 3 * len(state[group])
        names = state.names.dynamic_track_frame
        track = np.arange(len(state[group])) if names is None else names[:, 0]
        self.batches = [b for b in problem.batches if len(b)]
        self.bands = [self._plan_bands(batch, track) for batch in self.batches]
        columns, lengths = [np.zeros(0, dtype=np.int32)], [np.zeros(1, dtype=np.int64)]
        for batch in self.batches:
            d = batch.family.residual_dim
            of_row = np.concatenate([3 * s.rows[:, None] + np.arange(3) for s in batch.slots], axis=1)
            columns.append(np.repeat(of_row, d, axis=0).reshape(-1).astype(np.int32))
            lengths.append(np.full(len(batch) * d, of_row.shape[1]))
        self.indices, self.indptr = np.concatenate(columns), np.cumsum(np.concatenate(lengths))

    def _plan_bands(self, batch: FactorBatch, track: IntArray) -> list[_BandPlan]:
        plans = []
        for first in range(len(batch.slots)):
            for second in range(len(batch.slots)):
                p, q = batch.slots[first].rows, batch.slots[second].rows
                rows = np.flatnonzero((track[p] == track[q]) & (p >= q) & (p - q <= _REACH))
                if len(rows) == 0:
                    continue
                row = 3 * p[rows, None, None] + np.arange(3)[None, :, None]
                column = 3 * q[rows, None, None] + np.arange(3)[None, None, :]
                target = np.where(row >= column, (row - column) * self.size + column, -1)
                plans.append(_BandPlan(first, second, rows, target))
        return plans

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        return self.problem.energies(state)

    def retract(self, state: State, delta: FloatArray) -> State:
        """Return ``state`` with the points moved by ``delta`` (3 P,)."""
        return state.retract({self.group: delta.reshape(-1, 3)})

    def linearize(self, state: State) -> TrajectoryLinearization:
        """Return J, r and the banded preconditioner at ``state``."""
        values, residuals = [np.zeros(0)], [np.zeros(0)]
        bands = np.zeros(_BANDS * self.size)
        for batch, plans in zip(self.batches, self.bands, strict=True):
            r, jacobians = batch.linearize(state)
            values.append(np.concatenate(jacobians, axis=2).reshape(-1))
            residuals.append(r.reshape(-1))
            for plan in plans:
                a, b = jacobians[plan.first], jacobians[plan.second]
                if len(plan.rows) < len(batch):
                    a, b = a[plan.rows], b[plan.rows]
                products = np.swapaxes(a, 1, 2) @ b
                inside = plan.target >= 0
                bands += np.bincount(plan.target[inside], products[inside], len(bands))
        residual = np.concatenate(residuals)
        jacobian = scipy.sparse.csr_matrix(
            (np.concatenate(values), self.indices, self.indptr), shape=(len(residual), self.size)
        )
        return TrajectoryLinearization(self, jacobian, residual, bands.reshape(_BANDS, self.size))

    def diagnose(self, state: State) -> str:
        """Name the points that no factor determines."""
        diagonal = self.linearize(state).diagonal.reshape(-1, 3).min(axis=1)
        weak = np.flatnonzero(~(diagonal > 1e-12 * max(float(diagonal.max(initial=0.0)), 1e-300)))[:5]
        listed = "; ".join(str(decode(state.key(self.group, int(row)))) for row in weak)
        return f"Not determined: {listed or 'no single point'}. Give them observations, a depth or a smoothness prior."


class TrajectoryLinearization:
    """J, r and the per-track blocks of J^T J at one point."""

    def __init__(
        self, objective: TrajectoryObjective, jacobian: scipy.sparse.csr_matrix, residual: FloatArray, bands: FloatArray
    ):
        self.objective, self.jacobian, self.bands = objective, jacobian, bands
        self.gradient: FloatArray = jacobian.T @ residual
        self.diagonal: FloatArray = bands[0]

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient."""
        return float(np.abs(self.gradient).max(initial=0.0))

    def solve(self, damping: float) -> Step | None:
        """Return the inexact step, or None when the preconditioner is not positive definite."""
        config = self.objective.config
        added = damping * np.clip(self.diagonal, config.min_diagonal, config.max_diagonal)
        bands = self.bands.copy()
        bands[0] += added
        try:
            factor = scipy.linalg.cholesky_banded(bands, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        delta, iterations = self._conjugate_gradients(factor, added)
        if not np.isfinite(delta).all():
            return None
        moved = self.jacobian @ delta
        decrease = -(self.gradient @ delta) - 0.5 * (moved @ moved)
        return Step(delta, float(np.linalg.norm(delta)), float(max(decrease, 0.0)), iterations)

    def _conjugate_gradients(self, factor: FloatArray, added: FloatArray) -> tuple[FloatArray, int]:
        config, transposed = self.objective.config, self.jacobian.T

        def precondition(v: FloatArray) -> FloatArray:
            out: FloatArray = scipy.linalg.cho_solve_banded((factor, True), v, check_finite=False)
            return out

        x = np.zeros_like(self.gradient)
        r = -self.gradient
        z = precondition(r)
        p, rz = z, float(r @ z)
        target = config.cg_tolerance**2 * rz
        iteration = 0
        while iteration < config.cg_max_iterations and rz > target:
            product = transposed @ (self.jacobian @ p) + added * p
            alpha = rz / float(p @ product)
            x += alpha * p
            r -= alpha * product
            z = precondition(r)
            rz, previous = float(r @ z), rz
            p = z + (rz / previous) * p
            iteration += 1
        return x, iteration
