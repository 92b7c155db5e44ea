r"""Dense cameras, eliminated points: the landmark Schur complement on arrays.

The Gauss-Newton system of a problem whose factors read at most one row of the eliminated group splits into

    [ H_cc  E ] [d_c]     [g_c]
    [ E^T   V ] [d_l] = - [g_l],     V block-diagonal with 3x3 blocks.

Eliminating d_l leaves S = H_cc - E V^{-1} E^T on the cameras (poses, intrinsics, log-scales), which is
dense for long tracks and is solved by Cholesky; then each landmark is back-substituted on its own. E is
formed in chunks of landmarks that share a range of frames, so that S is a sum of dense products (BLAS) and
memory stays bounded. Marquardt damping is applied to landmarks and cameras alike, before elimination.
Source: Triggs et al. 2000, "Bundle adjustment - a modern synthesis".

With nothing to eliminate this is a dense normal-equation solver, as camera initialisation needs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.graph.keys import decode
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import TANGENT_DIM, State
from uni4d_fg.solve.layout import DenseLayout
from uni4d_fg.solve.objective import Step

_CHUNK = 1024
"""Landmarks eliminated together: large enough for BLAS, small enough for the cache."""


@dataclass(frozen=True)
class _BatchPlan:
    """A batch, its rows sorted by camera variables, and where its blocks go."""

    batch: FactorBatch
    camera_slots: tuple[int, ...]
    landmark_slot: int | None
    group_start: IntArray
    """First row of each run of rows with the same camera variables, plus the end."""
    columns: IntArray
    """(runs, D) columns of the camera Jacobian of each run."""
    by_landmark: IntArray
    """Rows sorted by landmark."""
    landmark_start: IntArray
    """(N_landmarks + 1,) first position of each landmark in ``by_landmark``."""
    unique_pairs: tuple[bool, ...]
    """Per camera slot: no two rows share both the landmark and the camera variable."""


@dataclass(frozen=True)
class _BatchBlocks:
    """What of a linearised batch the elimination needs."""

    coupling: FloatArray
    """(N, 3, D) J_l^T J_c per row."""


class SchurObjective:
    """A :class:`Problem` whose linear systems are solved by eliminating one group of points."""

    def __init__(self, problem: Problem, state: State, config: SolverConfig, eliminate: str | None = "landmark"):
        """Plan the sparsity once; it does not change between linearisations.

        Args:
            problem: Batches and free entries. The eliminated group is free as a whole row or frozen.
            state: Any state of the problem (only array lengths are read).
            config: Bounds of the damping diagonal.
            eliminate: Group of 3-vectors to eliminate; None, or a frozen group, eliminates nothing.
        """
        self.problem, self.config = problem, config
        self.eliminate = eliminate if eliminate is not None and problem.is_free(eliminate) else None
        groups = tuple(g for g in problem.free if problem.is_free(g) and g != self.eliminate)
        self.layout = DenseLayout.create(state, problem.free, groups)
        self.num_landmarks = len(state[self.eliminate]) if self.eliminate else 0
        self.landmark_free: BoolArray = np.zeros(0, dtype=bool)
        if self.eliminate is not None:
            self.landmark_free = np.asarray(problem.free[self.eliminate].all(axis=1))
        self.plans = [plan for batch in problem.batches if (plan := self._plan(batch)) is not None]
        self.chunks = self._plan_chunks()

    def _plan(self, batch: FactorBatch) -> _BatchPlan | None:
        camera_slots = tuple(i for i, s in enumerate(batch.slots) if s.group in self.layout.offset)
        landmark = [i for i, s in enumerate(batch.slots) if s.group == self.eliminate]
        if len(batch) == 0 or not (camera_slots or landmark):
            return None
        order = np.arange(len(batch))
        if camera_slots:
            order = np.lexsort([batch.slots[i].rows for i in reversed(camera_slots)])
        batch = batch.take(order)
        rows = np.stack([batch.slots[i].rows for i in camera_slots] or [np.zeros(len(batch), dtype=np.int64)], axis=1)
        new_run = np.flatnonzero(np.r_[True, (np.diff(rows, axis=0) != 0).any(axis=1)])
        columns = [self.layout.columns(batch.slots[i].group, batch.slots[i].rows[new_run]) for i in camera_slots]
        by_landmark, start = np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
        if landmark:
            landmark_rows = batch.slots[landmark[0]].rows
            by_landmark = np.argsort(landmark_rows, kind="stable")
            start = np.searchsorted(landmark_rows[by_landmark], np.arange(self.num_landmarks + 1))
        return _BatchPlan(
            batch,
            camera_slots,
            landmark[0] if landmark else None,
            np.r_[new_run, len(batch)],
            np.concatenate([*columns, np.zeros((len(new_run), 0), dtype=np.int64)], axis=1),
            by_landmark,
            start,
            tuple(_pairs_are_unique(batch, i, landmark) for i in camera_slots),
        )

    def _plan_chunks(self) -> list[IntArray]:
        """Order landmarks by the first frame that sees them, and cut them into chunks."""
        if self.num_landmarks == 0:
            return []
        first = np.full(self.num_landmarks, np.iinfo(np.int64).max)
        for plan in self.plans:
            if plan.landmark_slot is None:
                continue
            for i in plan.camera_slots:
                slot = plan.batch.slots[i]
                if self.layout.count[slot.group] > 1:
                    np.minimum.at(first, plan.batch.slots[plan.landmark_slot].rows, slot.rows)
        order = np.argsort(first, kind="stable")
        order = order[self.landmark_free[order]]
        return [order[i : i + _CHUNK] for i in range(0, len(order), _CHUNK)]

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        return self.problem.energies(state)

    def retract(self, state: State, delta: dict[str, FloatArray]) -> State:
        """Return ``state`` moved by a step per group."""
        return state.retract(delta)

    def linearize(self, state: State) -> SchurLinearization:
        """Accumulate the normal equations at ``state``."""
        size, count = self.layout.size, self.num_landmarks
        hessian, gradient = np.zeros((size, size)), np.zeros(size)
        point_hessian, point_gradient = np.zeros((count, 3, 3)), np.zeros((count, 3))
        blocks: list[_BatchBlocks | None] = []
        for plan in self.plans:
            r, jacobians = plan.batch.linearize(state)
            camera = np.concatenate([*(jacobians[i] for i in plan.camera_slots), np.zeros((*r.shape, 0))], axis=2)
            _add_camera_blocks(plan, camera, r, hessian, gradient)
            if plan.landmark_slot is None:
                blocks.append(None)
                continue
            by_point = jacobians[plan.landmark_slot]
            rows = plan.batch.slots[plan.landmark_slot].rows
            _add_point_blocks(rows, by_point, r, point_hessian, point_gradient)
            blocks.append(_BatchBlocks(np.swapaxes(by_point, 1, 2) @ camera))
        return SchurLinearization(self, hessian, gradient, point_hessian, point_gradient, blocks)

    def diagnose(self, state: State) -> str:
        """Name the free variables that no factor determines."""
        model = self.linearize(state)
        diagonal = np.diag(model.hessian)
        weak = np.flatnonzero(self.layout.free & ~(diagonal > 1e-12 * max(float(diagonal.max(initial=0.0)), 1e-300)))
        names = []
        for column in weak[:5]:
            group, row, _ = self.layout.locate(int(column))
            name = str(decode(state.key(group, row)))
            terms = sorted(
                {
                    plan.batch.name
                    for plan in self.plans
                    for i in plan.camera_slots
                    if plan.batch.slots[i].group == group and (plan.batch.slots[i].rows == row).any()
                }
            )
            names.append(f"{name} (factors: {', '.join(terms) or 'none'})")
        if names:
            listed = "; ".join(dict.fromkeys(names))
            return f"Not determined: {listed}. Give it observations or a prior, or freeze it."
        return (
            "No single variable is undetermined: a gauge freedom or parallel constraints remain; "
            "anchor a pose or the scale."
        )


def _add_camera_blocks(
    plan: _BatchPlan, camera: FloatArray, r: FloatArray, hessian: FloatArray, gradient: FloatArray
) -> None:
    width = camera.shape[2]
    if width == 0:
        return
    for run, columns in enumerate(plan.columns):
        rows = slice(plan.group_start[run], plan.group_start[run + 1])
        a = camera[rows].reshape(-1, width)
        hessian[np.ix_(columns, columns)] += a.T @ a
        gradient[columns] += a.T @ r[rows].reshape(-1)


def _add_point_blocks(
    rows: IntArray, by_point: FloatArray, r: FloatArray, point_hessian: FloatArray, point_gradient: FloatArray
) -> None:
    count = len(point_hessian)
    for a in range(3):
        point_gradient[:, a] += np.bincount(rows, np.einsum("nd,nd->n", by_point[:, :, a], r), count)
        for b in range(a, 3):
            block = np.bincount(rows, np.einsum("nd,nd->n", by_point[:, :, a], by_point[:, :, b]), count)
            point_hessian[:, a, b] += block
            if a != b:
                point_hessian[:, b, a] += block


@dataclass
class SchurLinearization:
    """The normal equations at one point."""

    objective: SchurObjective
    hessian: FloatArray
    gradient: FloatArray
    point_hessian: FloatArray
    point_gradient: FloatArray
    blocks: list[_BatchBlocks | None]
    _free: IntArray = field(init=False)

    def __post_init__(self) -> None:
        self._free = np.flatnonzero(self.objective.layout.free)

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient over the free entries."""
        camera = np.abs(self.gradient[self._free]).max(initial=0.0)
        point = np.abs(self.point_gradient[self.objective.landmark_free]).max(initial=0.0)
        return float(max(camera, point))

    def _clamped(self, diagonal: FloatArray) -> FloatArray:
        config = self.objective.config
        return np.clip(diagonal, config.min_diagonal, config.max_diagonal)

    def reduced(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return S, its right-hand side (both over all columns) and the inverse point factors (N, 3, 3).

        None when a damped landmark block is not positive definite.
        """
        size = self.objective.layout.size
        schur = self.hessian.copy()
        schur[np.arange(size), np.arange(size)] += damping * self._clamped(np.diag(self.hessian))
        rhs = -self.gradient
        point = self.point_hessian.copy()
        index = np.arange(3)
        point[:, index, index] += damping * self._clamped(self.point_hessian[:, index, index])
        try:
            inverse_factor = np.linalg.inv(np.linalg.cholesky(point)) if len(point) else point
        except np.linalg.LinAlgError:
            return None
        for chunk in self.objective.chunks:
            self._eliminate(chunk, inverse_factor, schur, rhs)
        return schur, rhs, inverse_factor

    def _eliminate(self, chunk: IntArray, inverse_factor: FloatArray, schur: FloatArray, rhs: FloatArray) -> None:
        """Subtract E V^{-1} E^T and E V^{-1} g_l of one chunk of landmarks."""
        coupling, columns = self._coupling(chunk)
        factor = inverse_factor[chunk]
        whitened = (factor @ coupling).reshape(-1, coupling.shape[2])
        whitened_gradient = (factor @ self.point_gradient[chunk, :, None]).reshape(-1)
        schur[np.ix_(columns, columns)] -= whitened.T @ whitened
        rhs[columns] += whitened.T @ whitened_gradient

    def _coupling(self, chunk: IntArray) -> tuple[FloatArray, IntArray]:
        """Return E^T of a chunk, (landmarks, 3, columns), and the dense columns it spans."""
        layout = self.objective.layout
        local = np.full(self.objective.num_landmarks, -1)
        local[chunk] = np.arange(len(chunk))
        pieces: list[tuple[str, IntArray, IntArray, FloatArray, bool]] = []
        for plan, block in zip(self.objective.plans, self.blocks, strict=True):
            if block is None or plan.landmark_slot is None or not plan.camera_slots:
                continue
            rows = _rows_of(plan, chunk)
            landmark = local[plan.batch.slots[plan.landmark_slot].rows[rows]]
            start = 0
            for i, unique in zip(plan.camera_slots, plan.unique_pairs, strict=True):
                slot = plan.batch.slots[i]
                dim = TANGENT_DIM[slot.group]
                values = block.coupling[rows, :, start : start + dim]
                pieces.append((slot.group, landmark, slot.rows[rows], values, unique))
                start += dim
        out, columns = [], []
        for group in layout.offset:
            mine = [p for p in pieces if p[0] == group and len(p[2])]
            if not mine:
                continue
            first = min(int(p[2].min()) for p in mine)
            count = max(int(p[2].max()) for p in mine) - first + 1
            dim = TANGENT_DIM[group]
            dense = np.zeros((len(chunk), count, 3, dim))
            for _, landmark, rows, values, unique in mine:
                _add_blocks(dense, landmark, rows - first, values, unique)
            out.append(np.swapaxes(dense, 1, 2).reshape(len(chunk), 3, count * dim))
            columns.append(layout.columns(group, np.arange(first, first + count)).reshape(-1))
        if not out:
            return np.zeros((len(chunk), 3, 0)), np.zeros(0, dtype=np.int64)
        return np.concatenate(out, axis=2), np.concatenate(columns)

    def solve(self, damping: float) -> Step | None:
        """Eliminate, solve the cameras, back-substitute the landmarks; None if not positive definite."""
        reduced = self.reduced(damping)
        if reduced is None:
            return None
        schur, rhs, inverse_factor = reduced
        layout, free = self.objective.layout, self._free
        camera_step = np.zeros(layout.size)
        if len(free):
            try:
                factor = scipy.linalg.cho_factor(schur[np.ix_(free, free)], lower=True, check_finite=False)
            except np.linalg.LinAlgError:
                return None
            camera_step[free] = scipy.linalg.cho_solve(factor, rhs[free], check_finite=False)
        point_step = self._back_substitute(camera_step, inverse_factor)
        delta = layout.split(camera_step)
        if self.objective.eliminate is not None:
            delta[self.objective.eliminate] = point_step
        if not all(np.isfinite(step).all() for step in delta.values()):
            return None
        return Step(delta, *self._step_size(camera_step, point_step, damping))

    def _back_substitute(self, camera_step: FloatArray, inverse_factor: FloatArray) -> FloatArray:
        rhs = self.point_gradient.copy()
        count = len(rhs)
        for plan, block in zip(self.objective.plans, self.blocks, strict=True):
            if block is None or plan.landmark_slot is None:
                continue
            run = np.repeat(np.arange(len(plan.columns)), np.diff(plan.group_start))
            moved = np.einsum("nad,nd->na", block.coupling, camera_step[plan.columns][run])
            rows = plan.batch.slots[plan.landmark_slot].rows
            for a in range(3):
                rhs[:, a] += np.bincount(rows, moved[:, a], count)
        half = inverse_factor @ rhs[:, :, None]
        step = -(np.swapaxes(inverse_factor, 1, 2) @ half)[:, :, 0]
        step[~self.objective.landmark_free] = 0.0
        return step

    def _step_size(self, camera: FloatArray, point: FloatArray, damping: float) -> tuple[float, float]:
        """Return the step's norm and the model's decrease, (-g.d + damping d.D.d) / 2."""
        index = np.arange(3)
        point_diagonal = self._clamped(self.point_hessian[:, index, index])
        damped = np.sum(self._clamped(np.diag(self.hessian)) * camera**2) + np.sum(point_diagonal * point**2)
        slope = -(self.gradient @ camera) - np.sum(self.point_gradient * point)
        norm = float(np.sqrt(np.sum(camera**2) + np.sum(point**2)))
        return norm, float(0.5 * (slope + damping * damped))


def _rows_of(plan: _BatchPlan, landmarks: IntArray) -> IntArray:
    """Return the batch rows of the given landmarks."""
    start, end = plan.landmark_start[landmarks], plan.landmark_start[landmarks + 1]
    lengths = end - start
    offsets = np.repeat(start - np.r_[0, np.cumsum(lengths)[:-1]], lengths)
    result: IntArray = plan.by_landmark[offsets + np.arange(int(lengths.sum()))]
    return result


def _pairs_are_unique(batch: FactorBatch, camera_slot: int, landmark_slots: list[int]) -> bool:
    if not landmark_slots:
        return True
    camera, landmark = batch.slots[camera_slot].rows, batch.slots[landmark_slots[0]].rows
    pair = landmark * (int(camera.max(initial=0)) + 1) + camera
    return len(np.unique(pair)) == len(pair)


def _add_blocks(dense: FloatArray, landmark: IntArray, rows: IntArray, values: FloatArray, unique: bool) -> None:
    """Add (n, 3, dim) blocks into dense[landmark, row]; pairs may repeat (shared intrinsics do)."""
    if unique:
        dense[landmark, rows] += values
    elif dense.shape[1] == 1:
        flat = values.reshape(len(values), -1)
        summed = np.stack([np.bincount(landmark, flat[:, j], len(dense)) for j in range(flat.shape[1])], axis=1)
        dense[:, 0] += summed.reshape(len(dense), *values.shape[1:])
    else:
        np.add.at(dense, (landmark, rows), values)
