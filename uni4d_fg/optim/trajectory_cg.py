r"""Inexact Gauss-Newton for many trajectories of points: conjugate gradients with a banded preconditioner.

The unknowns of non-rigid bundle adjustment form a mesh in (track, time): temporal smoothness couples a
track with itself, as-rigid-as-possible couples tracks. Direct elimination fills in and grows faster than
linearly. Here the damped normal equations (J^T J + damping D) d = -J^T r are solved by conjugate gradients.
The preconditioner is the exact block of every track on its own - all of its time steps with each other up to
two frames apart - which is a banded matrix with nine diagonals when points are ordered by track and time,
factored by one banded Cholesky. What it leaves out is the coupling between tracks, so that few steps are
needed, and each costs time linear in the number of factors: factors within a track are multiplied as a
banded matrix, those between tracks by their sparse J and J^T. The inner solve is inexact (Nash and Sofer's
relative-residual rule).
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.optim.bands import BANDS, BandAssembler, symmetric, within_reach
from uni4d_fg.optim.diagnosis import undetermined, undetermined_message
from uni4d_fg.optim.objective import SolvedPart, Step
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.threads import map_in_order, one_blas_thread, thread_count

_PIECE_ROWS = 8192
"""Factors linearized together: their temporaries fit the cache."""


class _Planned:
    """A batch, cut into pieces, and where its Jacobians go."""

    def __init__(self, batch: FactorBatch, track: IntArray):
        n, d = len(batch), batch.factor_type.dim
        self.batch = batch
        self.assembler = BandAssembler([s.rows for s in batch.slots], track)
        self.starts = range(0, n, _PIECE_ROWS)
        self.pieces = [batch.take(np.arange(start, min(start + _PIECE_ROWS, n))) for start in self.starts]
        self.residual: FloatArray = np.zeros((d, n))
        self.components: list[FloatArray] = [np.zeros((d, 3, n)) for _ in batch.slots]
        """Jacobians per slot with the factor last, so that sums over factors run along memory."""
        self.jacobian: FloatArray | None = None
        """(n, d, slots, 3) view into the sparse J, for factors between tracks."""

    def linearize(self, piece: int, state: State, kernel_curvature: float) -> None:
        """Write the residuals and Jacobians of one piece."""
        r, jacobians = self.pieces[piece].linearize(state, kernel_curvature)
        rows = slice(self.starts[piece], self.starts[piece] + len(r))
        self.residual[:, rows] = r.T
        for slot, jacobian in enumerate(jacobians):
            self.components[slot][:, :, rows] = np.moveaxis(jacobian, 0, 2)
            if self.jacobian is not None:
                self.jacobian[rows, :, slot] = jacobian


class TrajectoryObjective:
    """A :class:`Problem` on one variable of points ordered by track and frame, all of them free."""

    def __init__(
        self,
        problem: Problem,
        state: State,
        config: SolverConfig,
        variable: VariableType = DYNAMIC_POINT,
        threads: int | None = None,
    ):
        """Plan the sparsity of J and of the preconditioner once.

        Args:
            problem: Batches that read rows of ``variable`` only.
            state: State whose ``names.dynamic_track_frame`` gives the track of each row; rows of one track
                must be consecutive and in the order of their frames.
            config: Tolerance of the inner solve and bounds of the damping diagonal.
            variable: The point variable.
            threads: Worker threads; the number of cores when None.

        Raises:
            SolverError: If a batch reads another variable, or some of the points are frozen.
        """
        self.problem, self.config, self.variable = problem, config, variable
        self.num_points = len(state[variable])
        self.size = 3 * self.num_points
        if variable not in problem.free or not problem.free[variable].all():
            raise SolverError(f"the trajectory solver moves every {variable}: none can be frozen")
        for batch in problem.batches:
            if any(s.variable != variable for s in batch.slots):
                raise SolverError(f"{batch.name}: the trajectory solver takes factors on {variable} only")
        track = state.numbers(variable)[:, 0]
        self._inside: list[_Planned] = []
        self._across: list[_Planned] = []
        for batch in problem.batches:
            own_track = within_reach([s.rows for s in batch.slots], track)
            for planned, rows in (
                (self._inside, np.flatnonzero(own_track)),
                (self._across, np.flatnonzero(~own_track)),
            ):
                if len(rows):
                    planned.append(_Planned(batch.take(rows), track))
        self._tasks = [(p, i) for p in self._inside + self._across for i in range(len(p.pieces))]
        self.threads = min(thread_count(threads), max(len(self._tasks), 1))
        self._plan_jacobian()

    def _plan_jacobian(self) -> None:
        """Lay out the sparse J of the factors between tracks, and its transpose, as CSR."""
        columns, lengths = [np.zeros(0, dtype=np.int32)], [np.zeros(1, dtype=np.int32)]
        for batch in (planned.batch for planned in self._across):
            d = batch.factor_type.dim
            of_row = np.concatenate([3 * s.rows[:, None] + np.arange(3) for s in batch.slots], axis=1)
            columns.append(np.repeat(of_row, d, axis=0).reshape(-1).astype(np.int32))
            lengths.append(np.full(len(batch) * d, of_row.shape[1], dtype=np.int32))
        indices, indptr = np.concatenate(columns), np.cumsum(np.concatenate(lengths), dtype=np.int32)
        shape = (len(indptr) - 1, self.size)
        self._jacobian = scipy.sparse.csr_matrix((np.zeros(len(indices)), indices, indptr), shape=shape)
        start = 0
        for planned in self._across:
            d, count, slots = planned.batch.factor_type.dim, len(planned.batch), len(planned.batch.slots)
            stop = start + count * d * 3 * slots
            planned.jacobian = self._jacobian.data[start:stop].reshape(count, d, slots, 3)
            start = stop
        positions = np.arange(len(indices), dtype=np.int32)
        by_column = scipy.sparse.csr_matrix((positions, indices, indptr), shape=shape).tocsc()
        self._transposed_order = by_column.data
        self._transposed = scipy.sparse.csr_matrix(
            (np.zeros(len(indices)), by_column.indices, by_column.indptr), shape=shape[::-1]
        )

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        out = {batch.name: 0.0 for batch in self.problem.batches}
        energies = map_in_order(lambda task: task[0].pieces[task[1]].energy(state), self._tasks, self.threads)
        for (planned, _), energy in zip(self._tasks, energies, strict=True):
            out[planned.batch.name] += energy
        return out

    def retract(self, state: State, delta: FloatArray) -> State:
        """Return ``state`` with the points moved by ``delta`` (3 P,)."""
        return state.retract({self.variable: delta.reshape(-1, 3)})

    def linearize(self, state: State) -> TrajectoryLinearization:
        """Return the gradient and J^T J at ``state``; they are valid until the next call."""
        return self._linearize(state, 0.0)

    def linearize_curved(self, state: State) -> TrajectoryLinearization:
        """Return the same with the part ``kernel_curvature`` of the kernels' curvature."""
        return self._linearize(state, self.config.kernel_curvature)

    def _linearize(self, state: State, kernel_curvature: float) -> TrajectoryLinearization:
        map_in_order(lambda task: task[0].linearize(task[1], state, kernel_curvature), self._tasks, self.threads)
        gradient, bands = np.zeros(self.size), np.zeros((BANDS, self.size))
        for planned in self._inside:
            planned.assembler.add_gradient(planned.components, planned.residual, gradient)
            planned.assembler.add_bands(planned.components, bands)
        inside = symmetric(bands)
        for planned in self._across:
            planned.assembler.add_bands(planned.components, bands)
        np.take(self._jacobian.data, self._transposed_order, out=self._transposed.data, mode="clip")
        residuals = [np.zeros(0), *(planned.residual.T.reshape(-1) for planned in self._across)]
        gradient += self._transposed @ np.concatenate(residuals)
        return TrajectoryLinearization(self.config, gradient, bands, inside, self._jacobian, self._transposed)

    def parts(self) -> list[SolvedPart]:
        """Return that NumPy does everything."""
        return [SolvedPart("NumPy trajectories", tuple(dict.fromkeys(b.name for b in self.problem.batches)))]

    def diagnose(self, state: State) -> str:
        """Name the points that no factor determines."""
        bands = self.linearize(state).bands
        blocks = np.zeros((self.num_points, 3, 3))
        for a in range(3):
            for b in range(a + 1):
                blocks[:, a, b] = blocks[:, b, a] = bands[a - b, b::3]
        rows = undetermined(blocks)
        return undetermined_message(self.problem, state, [(self.variable, row) for row in rows.tolist()])


class TrajectoryLinearization:
    """The gradient, J^T J as a product, and its per-track blocks, at one point."""

    def __init__(
        self,
        config: SolverConfig,
        gradient: FloatArray,
        bands: FloatArray,
        inside: scipy.sparse.dia_matrix,
        jacobian: scipy.sparse.csr_matrix,
        transposed: scipy.sparse.csr_matrix,
    ):
        """Store the model.

        Args:
            config: Tolerance of the inner solve and bounds of the damping diagonal.
            gradient: (n,).
            bands: (BANDS, n) blocks of J^T J within each track, LAPACK's lower form.
            inside: (n, n) J^T J of the factors within one track.
            jacobian: J of all other factors.
            transposed: Its transpose.
        """
        self.config, self.gradient, self.bands = config, gradient, bands
        self._inside, self._jacobian, self._transposed = inside, jacobian, transposed

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient."""
        return float(np.abs(self.gradient).max(initial=0.0))

    def multiply(self, vector: FloatArray) -> FloatArray:
        """Return (J^T J) ``vector``."""
        result: FloatArray = self._transposed @ (self._jacobian @ vector)
        result += self._inside @ vector
        return result

    def solve(self, damping: float) -> Step | None:
        """Return the inexact step, or None when the preconditioner is not positive definite."""
        added = damping * np.clip(self.bands[0], self.config.min_diagonal, self.config.max_diagonal)
        factor = np.array(self.bands, order="F")
        factor[0] += added
        factor, failed = scipy.linalg.lapack.dpbtrf(factor, lower=1, overwrite_ab=1)
        if failed:
            return None
        with one_blas_thread():  # waking a second thread takes longer than these vector operations
            delta, iterations = self._conjugate_gradients(factor, added)
            if not np.isfinite(delta).all():
                return None
            curvature = float(delta @ self.multiply(delta))
            decrease = -float(self.gradient @ delta) - 0.5 * curvature
            return Step(delta, float(np.linalg.norm(delta)), max(decrease, 0.0), iterations)

    def _conjugate_gradients(self, factor: FloatArray, added: FloatArray) -> tuple[FloatArray, int]:
        def precondition(v: FloatArray) -> FloatArray:
            out: FloatArray = scipy.linalg.lapack.dpbtrs(factor, v, lower=1)[0]
            return out

        x = np.zeros_like(self.gradient)
        r = -self.gradient
        z = precondition(r)
        p, rz = z, float(r @ z)
        target = self.config.cg_tolerance**2 * rz
        iteration = 0
        while iteration < self.config.cg_max_iterations and rz > target:
            product = self.multiply(p)
            product += added * p
            alpha = rz / float(p @ product)
            x += alpha * p
            r -= alpha * product
            z = precondition(r)
            rz, previous = float(r @ z), rz
            p = z + (rz / previous) * p
            iteration += 1
        return x, iteration
