r"""Dense cameras, eliminated points: the landmark Schur complement on arrays.

The Gauss-Newton system of a problem whose factors read at most one row of the eliminated variable splits into

    [ H_cc  E ] [d_c]     [g_c]
    [ E^T   V ] [d_l] = - [g_l],     V block-diagonal with 3x3 blocks.

Eliminating d_l leaves S = H_cc - E V^{-1} E^T on the cameras (poses, intrinsics, log-scales), which is
dense for long tracks and is solved by Cholesky; then each landmark is back-substituted on its own. All work
is cut into chunks of landmarks that share a range of frames: a chunk's factors fit the cache, its part of E
is one dense block, S is a sum of dense products, and chunks run on several threads. Partial sums are added
in a fixed order, so that the result does not depend on the number of threads. Marquardt damping is applied
to landmarks and cameras alike, before elimination.
Source: Triggs et al. 2000, "Bundle adjustment - a modern synthesis".

With nothing to eliminate this is a dense normal-equation solver, as camera initialization needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import LANDMARK
from uni4d_fg.optim.chunks import BatchPart, Chunk, plan_chunks
from uni4d_fg.optim.diagnosis import GAUGE_MESSAGE, null_directions_message, undetermined, undetermined_message
from uni4d_fg.optim.landmark_steps import settle_points
from uni4d_fg.optim.layout import DenseLayout
from uni4d_fg.optim.objective import SolvedPart, Step
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.threads import ItemT, ResultT, map_in_order, one_blas_thread, thread_count


@dataclass(frozen=True)
class _ChunkBlocks:
    """Normal equations of one chunk."""

    camera_columns: IntArray
    """(c,) dense columns that the chunk's factors touch, ascending."""
    camera_hessian: FloatArray
    """(c, c)."""
    camera_gradient: FloatArray
    """(c,)."""
    point_hessian: FloatArray
    """(n, 3, 3)."""
    point_gradient: FloatArray
    """(n, 3)."""
    coupling: list[FloatArray]
    """Per span of the chunk (n, width, 3): J_c^T J_l, dense."""
    span_columns: IntArray
    """(sum of widths,) dense columns of the concatenated spans."""


class SchurObjective:
    """A :class:`Problem` whose linear systems are solved by eliminating one variable of points."""

    def __init__(
        self,
        problem: Problem,
        state: State,
        config: SolverConfig,
        eliminate: VariableType | None = LANDMARK,
        threads: int | None = None,
    ):
        """Plan the sparsity once; it does not change between linearizations.

        Args:
            problem: Batches and free entries. A factor reads at most one row of the eliminated variable; a row of
                that variable is free as a whole or frozen.
            state: Any state of the problem (only array lengths are read).
            config: Bounds of the damping diagonal.
            eliminate: Group of 3-vectors to eliminate; None, or a frozen variable, eliminates nothing.
            threads: Worker threads; the number of cores when None.

        Raises:
            SolverError: If a factor reads two rows of the eliminated variable, or one is frozen in part.
        """
        self.problem, self.config = problem, config
        self.eliminate = eliminate if eliminate is not None and problem.is_free(eliminate) else None
        if self.eliminate is not None and problem.is_free_in_part(self.eliminate):
            raise SolverError(
                f"some entries of a {eliminate} variable are frozen and others are not; it cannot be eliminated"
            )
        for batch in problem.batches:
            if self.eliminate is not None and sum(s.variable == self.eliminate for s in batch.slots) > 1:
                raise SolverError(f"{batch.name}: reads several {self.eliminate} rows; they cannot be eliminated")
        groups = tuple(g for g in problem.free if problem.is_free(g) and g != self.eliminate)
        self.layout = DenseLayout.create(state, problem.free, groups)
        self.num_landmarks = len(state[self.eliminate]) if self.eliminate else 0
        self.landmark_free: BoolArray = np.zeros(0, dtype=bool)
        if self.eliminate is not None:
            self.landmark_free = np.asarray(problem.free[self.eliminate].all(axis=1))
        self.chunks = plan_chunks(problem, self.layout, self.eliminate, self.num_landmarks)
        self._constant = self._constant_batches()
        self.threads = min(thread_count(threads), max(len(self.chunks), 1))
        # E is by far the largest array: allocated once, overwritten by every linearization.
        self._coupling = [
            [np.zeros((len(chunk.landmarks), span.count, span.dim, 3)) for span in chunk.spans] for chunk in self.chunks
        ]

    def _constant_batches(self) -> list[FactorBatch]:
        """Return the factors that no chunk holds because nothing they read may move."""
        out = []
        for batch in self.problem.batches:
            if any(s.variable in self.layout.offset for s in batch.slots):
                continue
            landmark = next((s.rows for s in batch.slots if s.variable == self.eliminate), None)
            out.append(batch if landmark is None else batch.take(np.flatnonzero(~self.landmark_free[landmark])))
        return out

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        parts = [part.batch for chunk in self.chunks for part in chunk.parts] + self._constant
        out = {batch.name: 0.0 for batch in self.problem.batches}
        for batch, energy in zip(parts, self._map(lambda batch: batch.energy(state), parts), strict=True):
            out[batch.name] += energy
        return out

    def retract(self, state: State, delta: dict[VariableType, FloatArray]) -> State:
        """Return ``state`` moved by a step per variable, landmarks then on alone if ``landmark_steps`` says so."""
        moved = state.retract(delta)
        if self.eliminate is None or not self.config.landmark_steps:
            return moved
        return settle_points(self.problem.batches, moved, self.eliminate, self.landmark_free, self.config)

    def linearize(self, state: State) -> SchurLinearization:
        """Accumulate the normal equations at ``state``; they are valid until the next call."""
        indices = list(range(len(self.chunks)))
        blocks = self._map(lambda i: _linearize_chunk(self.chunks[i], state, self._coupling[i]), indices)
        return SchurLinearization(self, blocks)

    def _map(self, function: Callable[[ItemT], ResultT], items: list[ItemT]) -> list[ResultT]:
        """Apply a function to every item on the worker threads; results in the order of the items."""
        return map_in_order(function, items, self.threads)

    def parts(self) -> list[SolvedPart]:
        """Return that NumPy does everything."""
        by = "NumPy dense system" if self.eliminate is None else f"NumPy {self.eliminate} elimination"
        return [SolvedPart(by, tuple(dict.fromkeys(b.name for b in self.problem.batches)))]

    def diagnose(self, state: State) -> str:
        """Name the free variables that no factor determines, or the directions that stay free together."""
        linearization = self.linearize(state)
        variables: list[tuple[VariableType, int]] = []
        for variable, count in self.layout.count.items():
            columns = self.layout.columns(variable, np.arange(count))
            blocks = linearization.hessian[columns[:, :, None], columns[:, None, :]]
            variables += [(variable, row) for row in undetermined(blocks, self.layout.free[columns]).tolist()]
        if self.eliminate is not None:
            blocks = np.tile(np.eye(3), (self.num_landmarks, 1, 1))
            for chunk, block in zip(self.chunks, linearization.blocks, strict=True):
                blocks[chunk.landmarks] = block.point_hessian
            variables += [(self.eliminate, row) for row in undetermined(blocks).tolist()]
        if variables:
            return undetermined_message(self.problem, state, variables)
        reduced = linearization.reduced(0.0)
        free = np.flatnonzero(self.layout.free)
        if reduced is None:
            return GAUGE_MESSAGE
        names = [str(state.describe(*self.layout.locate(column)[:2])) for column in free.tolist()]
        message = null_directions_message(reduced[0][np.ix_(free, free)], np.diag(linearization.hessian)[free], names)
        return message or GAUGE_MESSAGE


def _linearize_chunk(chunk: Chunk, state: State, coupling: list[FloatArray]) -> _ChunkBlocks:
    width, count = len(chunk.camera_columns), len(chunk.landmarks)
    hessian, gradient = np.zeros((width, width)), np.zeros(width)
    point_hessian, point_gradient = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for block in coupling:
        block.fill(0.0)
    for part in chunk.parts:
        r, jacobians = part.batch.linearize(state)
        camera = np.concatenate([*(jacobians[i] for i in part.camera_slots), np.zeros((*r.shape, 0))], axis=2)
        _add_camera_blocks(part, camera, r, hessian, gradient)
        if part.landmark_slot is None:
            continue
        by_point = jacobians[part.landmark_slot]
        _add_point_blocks(part.landmark, by_point, r, point_hessian, point_gradient)
        products = np.swapaxes(camera, 1, 2) @ by_point
        for target in part.coupling:
            values = products[:, target.start : target.stop]
            _add_coupling(coupling[target.span], part.landmark, target.row, values, target.unique)
    flat = [block.reshape(count, block.shape[1] * block.shape[2], 3) for block in coupling]
    return _ChunkBlocks(
        chunk.camera_columns, hessian, gradient, point_hessian, point_gradient, flat, chunk.span_columns
    )


def _add_camera_blocks(
    part: BatchPart, camera: FloatArray, r: FloatArray, hessian: FloatArray, gradient: FloatArray
) -> None:
    width = camera.shape[2]
    if width == 0:
        return
    for run, columns in enumerate(part.columns):
        rows = slice(part.run_start[run], part.run_start[run + 1])
        a = camera[rows].reshape(-1, width)
        # A variable may stand in two slots of one factor: add, entry by entry, only then.
        if part.distinct_columns:
            hessian[np.ix_(columns, columns)] += a.T @ a
            gradient[columns] += a.T @ r[rows].reshape(-1)
        else:
            np.add.at(hessian, np.ix_(columns, columns), a.T @ a)
            np.add.at(gradient, columns, a.T @ r[rows].reshape(-1))


def _add_point_blocks(
    landmark: IntArray, by_point: FloatArray, r: FloatArray, point_hessian: FloatArray, point_gradient: FloatArray
) -> None:
    count = len(point_hessian)
    for a in range(3):
        point_gradient[:, a] += np.bincount(landmark, np.einsum("nd,nd->n", by_point[:, :, a], r), count)
        for b in range(a, 3):
            block = np.bincount(landmark, np.einsum("nd,nd->n", by_point[:, :, a], by_point[:, :, b]), count)
            point_hessian[:, a, b] += block
            if a != b:
                point_hessian[:, b, a] += block


def _add_coupling(dense: FloatArray, landmark: IntArray, row: IntArray, values: FloatArray, unique: bool) -> None:
    """Add (n, dim, 3) blocks into dense[landmark, row]; pairs may repeat (shared intrinsics do)."""
    if unique:
        dense[landmark, row] += values
    elif dense.shape[1] == 1:
        flat = values.reshape(len(values), -1)
        summed = np.stack([np.bincount(landmark, flat[:, j], len(dense)) for j in range(flat.shape[1])], axis=1)
        dense[:, 0] += summed.reshape(len(dense), *values.shape[1:])
    else:
        np.add.at(dense, (landmark, row), values)


class SchurLinearization:
    """The normal equations at one point."""

    def __init__(self, objective: SchurObjective, blocks: list[_ChunkBlocks]):
        self.objective, self.blocks = objective, blocks
        size = objective.layout.size
        self.hessian, self.gradient = np.zeros((size, size)), np.zeros(size)
        for block in blocks:
            self.hessian[np.ix_(block.camera_columns, block.camera_columns)] += block.camera_hessian
            self.gradient[block.camera_columns] += block.camera_gradient
        self._free = np.flatnonzero(objective.layout.free)

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient over the free entries."""
        point = [np.abs(block.point_gradient).max(initial=0.0) for block in self.blocks]
        return float(max(np.abs(self.gradient[self._free]).max(initial=0.0), *point, 0.0))

    def _clamped(self, diagonal: FloatArray) -> FloatArray:
        config = self.objective.config
        return np.clip(diagonal, config.min_diagonal, config.max_diagonal)

    def reduced(self, damping: float) -> tuple[FloatArray, FloatArray, list[FloatArray]] | None:
        """Eliminate the landmarks.

        Returns:
            S (size, size) and its right-hand side (size,) over all columns, frozen ones included, and the
            inverse Cholesky factor of every landmark's damped block per chunk, (n, 3, 3); None when a
            landmark's block is not positive definite.
        """
        size = self.objective.layout.size
        schur, rhs = self.hessian.copy(), -self.gradient
        schur[np.arange(size), np.arange(size)] += damping * self._clamped(np.diag(self.hessian))

        def eliminate(block: _ChunkBlocks) -> tuple[FloatArray, FloatArray, FloatArray] | None:
            return self._eliminate(block, damping)

        factors = []
        for block, part in zip(self.blocks, self.objective._map(eliminate, self.blocks), strict=True):
            if part is None:
                return None
            inverse_factor, product, product_rhs = part
            columns = block.span_columns
            schur[np.ix_(columns, columns)] -= product
            rhs[columns] += product_rhs
            factors.append(inverse_factor)
        return schur, rhs, factors

    def _eliminate(self, block: _ChunkBlocks, damping: float) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return L^{-1} (n, 3, 3), E V^{-1} E^T and E V^{-1} g_l of one chunk, V = L L^T damped."""
        count, width = len(block.point_gradient), len(block.span_columns)
        point, index = block.point_hessian.copy(), np.arange(3)
        point[:, index, index] += damping * self._clamped(block.point_hessian[:, index, index])
        try:
            inverse_factor = np.linalg.inv(np.linalg.cholesky(point)) if count else point
        except np.linalg.LinAlgError:
            return None
        transposed = np.swapaxes(inverse_factor, 1, 2)
        whitened = np.empty((width, count, 3))
        start = 0
        for coupling in block.coupling:
            stop = start + coupling.shape[1]
            whitened[start:stop] = np.swapaxes(coupling @ transposed, 0, 1)
            start = stop
        flat = whitened.reshape(width, 3 * count)
        gradient = (inverse_factor @ block.point_gradient[:, :, None]).reshape(-1)
        return inverse_factor, flat @ flat.T, flat @ gradient

    def solve(self, damping: float) -> Step | None:
        """Eliminate, solve the cameras, back-substitute the landmarks; None if not positive definite."""
        reduced = self.reduced(damping)
        if reduced is None:
            return None
        schur, rhs, factors = reduced
        layout, free = self.objective.layout, self._free
        camera_step = np.zeros(layout.size)
        if len(free):
            try:
                with one_blas_thread():  # a second thread costs more than it gains at this size
                    factor = scipy.linalg.cho_factor(schur[np.ix_(free, free)], lower=True, check_finite=False)
            except np.linalg.LinAlgError:
                return None
            camera_step[free] = scipy.linalg.cho_solve(factor, rhs[free], check_finite=False)
        delta = layout.split(camera_step)
        if self.objective.eliminate is not None:
            delta[self.objective.eliminate] = self._back_substitute(camera_step, factors)
        if not all(np.isfinite(step).all() for step in delta.values()):
            return None
        return Step(delta, *self._step_size(camera_step, delta, damping))

    def _back_substitute(self, camera_step: FloatArray, factors: list[FloatArray]) -> FloatArray:
        """Return d_l = -V^{-1} (g_l + E^T d_c), (N, 3); zero for frozen landmarks."""
        step = np.zeros((self.objective.num_landmarks, 3))
        for chunk, block, factor in zip(self.objective.chunks, self.blocks, factors, strict=True):
            if len(chunk.landmarks) == 0:
                continue
            moved, start = block.point_gradient.copy(), 0
            for coupling in block.coupling:
                stop = start + coupling.shape[1]
                moved += camera_step[block.span_columns[start:stop]] @ coupling
                start = stop
            half = factor @ moved[:, :, None]
            step[chunk.landmarks] = -(np.swapaxes(factor, 1, 2) @ half)[:, :, 0]
        return step

    def _step_size(
        self, camera: FloatArray, delta: dict[VariableType, FloatArray], damping: float
    ) -> tuple[float, float]:
        """Return the step's norm and the model's decrease, (-g.d + damping d.D.d) / 2."""
        index = np.arange(3)
        slope = -(self.gradient @ camera)
        damped = np.sum(self._clamped(np.diag(self.hessian)) * camera**2)
        squared = camera @ camera
        for chunk, block in zip(self.objective.chunks, self.blocks, strict=True):
            if len(chunk.landmarks):
                assert self.objective.eliminate is not None
                point = delta[self.objective.eliminate][chunk.landmarks]
                slope -= np.sum(block.point_gradient * point)
                damped += np.sum(self._clamped(block.point_hessian[:, index, index]) * point**2)
                squared += np.sum(point**2)
        return float(np.sqrt(squared)), float(0.5 * (slope + damping * damped))
