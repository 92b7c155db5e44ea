"""The camera system of bundle adjustment: where its columns stand, and the factors that read no landmark.

The core holds the free entries of pose and log-scale frame by frame, so that frames which share no landmark
leave it banded; where no factor reads a log-scale, the zoom of each frame takes its place. The shared intrinsics are
its border, and after them every other variable that is free, of whatever type. Storage is LAPACK's lower triangle,
one row of the array per column: entry (i, j), i >= j, stands at ``[j, i]`` of a dense core and at ``[j, i - j]`` of a
banded one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.factor_type import Linearized
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE, ZOOM
from uni4d_fg.optim.layout import DenseLayout
from uni4d_fg.optim.problem import Problem

INTRINSICS_COLUMNS = 4
"""Border columns of the intrinsics, frozen ones included."""
_GROUPED = 16
"""Factors on the same variables from which on, at the mean, they are summed before they are added to the system."""
_BAND_FRACTION = 0.4
"""A core is stored as a band if the band is narrower than this part of its size."""


@dataclass
class CameraSystem:
    """Normal equations, or a reduced system, of the cameras."""

    core: FloatArray
    """(n, stored rows)."""
    border: FloatArray
    """(n, b), b = 4 for the intrinsics and one for every entry of other variables."""
    corner: FloatArray
    """(b, b)."""
    gradient: FloatArray
    """(n + b,) gradient, or right-hand side of a reduced system."""

    def widened(self, width: int) -> CameraSystem:
        """Return the system with a border of ``width`` columns, new ones zero; itself if it is as wide."""
        more = width - self.border.shape[1]
        if more == 0:
            return self
        return CameraSystem(
            self.core,
            np.pad(self.border, ((0, 0), (0, more))),
            np.pad(self.corner, ((0, more), (0, more))),
            np.pad(self.gradient, (0, more)),
        )

    def narrowed(self, width: int) -> CameraSystem:
        """Return the system with the first ``width`` columns of its border, as contiguous arrays."""
        if width == self.border.shape[1]:
            return self
        return CameraSystem(
            self.core,
            np.ascontiguousarray(self.border[:, :width]),
            np.ascontiguousarray(self.corner[:width, :width]),
            np.ascontiguousarray(self.gradient[: len(self.core) + width]),
        )

    def subtract(self, rows: IntArray, columns: IntArray, block: FloatArray, banded: bool) -> None:
        """Subtract a block (r, c) at pairwise distinct rows and columns; of the core its lower triangle is kept."""
        n = len(self.core)
        row, column = np.broadcast_arrays(rows[:, None], columns[None, :])
        inner = (row < n) & (column <= row)
        if banded:
            inner &= row - column < self.core.shape[1]
        i, j = row[inner], column[inner]
        self.core[j, i - j if banded else i] -= block[inner]
        edge = (row < n) & (column >= n)
        self.border[row[edge], column[edge] - n] -= block[edge]
        corner = (row >= n) & (column >= n)
        self.corner[row[corner] - n, column[corner] - n] -= block[corner]


@dataclass(frozen=True)
class CameraColumns:
    """The order of the camera system's columns, and its storage."""

    core: IntArray
    """(T, 7) core column of each pose entry and of the log-scale or zoom; -1 if frozen."""
    of_frame: Mapping[VariableType, slice]
    """Which of these seven a variable has."""
    layout_columns: IntArray
    """(n + b,) column in the dense layout of each column; -1 for frozen intrinsics."""
    extra: Mapping[VariableType, IntArray]
    """Per other variable type the column (rows, dim) of each entry; -1 if frozen."""
    size: int
    """Core columns n."""
    stored_rows: int
    banded: bool

    @classmethod
    def create(cls, problem: Problem, layout: DenseLayout, num_frames: int, landmark_free: BoolArray) -> CameraColumns:
        """Order the columns and measure how far apart frames that share a factor or a free landmark are."""
        free = np.zeros((num_frames, 7), dtype=bool)
        in_layout = np.full((num_frames, 7), -1)
        of_frame = {POSE: slice(0, 6), _last_of_a_frame(problem, layout, num_frames): slice(6, 7)}
        for variable, columns in of_frame.items():
            if variable in layout.offset:
                in_layout[:, columns] = layout.columns(variable, np.arange(num_frames))
                free[:, columns] = layout.free[in_layout[:, columns]]
        core = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
        border = np.full(INTRINSICS_COLUMNS, -1)
        if INTRINSICS in layout.offset:
            border = layout.columns(INTRINSICS, np.arange(1))[0]
            border = np.where(layout.free[border], border, -1)
        size = int(free.sum())
        extra: dict[VariableType, IntArray] = {}
        others, width = [np.zeros(0, dtype=np.int64)], size + INTRINSICS_COLUMNS
        for variable, count in layout.count.items():
            if variable is not INTRINSICS and variable not in of_frame:
                in_other = layout.columns(variable, np.arange(count))
                movable = layout.free[in_other]
                extra[variable] = np.where(movable, width + np.cumsum(movable).reshape(movable.shape) - 1, -1)
                others.append(in_other[movable])
                width += int(movable.sum())
        end = np.cumsum(free.sum(axis=1))
        start = end - free.sum(axis=1)
        width = int((end - start).max(initial=0))
        first, last = _frame_range(problem, num_frames, landmark_free, of_frame)
        seen = last >= 0
        width = max(width, int((end[last[seen]] - start[first[seen]]).max(initial=0)))
        for batch in problem.batches:
            frames = [s.rows for s in batch.slots if s.variable in of_frame and s.variable in layout.offset]
            if frames and len(batch):
                width = max(width, int((end[np.max(frames, axis=0)] - start[np.min(frames, axis=0)]).max()))
        banded = width < _BAND_FRACTION * size
        layout_columns: IntArray = np.concatenate([in_layout[free], border, *others])
        return cls(core, of_frame, layout_columns, extra, size, width if banded else size, banded)

    @property
    def border(self) -> int:
        """Width b of the border."""
        return len(self.layout_columns) - self.size

    def of_slot(self, variable: VariableType, rows: IntArray) -> IntArray:
        """Return the columns (N, dim) of rows (N,) of a variable; border columns from n on; -1 if frozen."""
        if variable in self.of_frame:
            return self.core[rows, self.of_frame[variable]]
        if variable in self.extra:
            return self.extra[variable][rows]
        known = self.layout_columns[self.size : self.size + INTRINSICS_COLUMNS] >= 0
        column = np.where(known, self.size + np.arange(INTRINSICS_COLUMNS), -1)
        return np.broadcast_to(column, (len(rows), INTRINSICS_COLUMNS))

    def has(self, variable: VariableType) -> bool:
        """Return whether a variable type stands in the camera system; landmarks do not."""
        return variable is INTRINSICS or variable in self.of_frame or variable in self.extra

    def diagonal(self, system: CameraSystem) -> FloatArray:
        """Return the diagonal of core and corner, (n + b,)."""
        index = np.arange(self.size)
        core = system.core[:, 0] if self.banded and self.size else system.core[index, index]
        return np.concatenate([core, np.diag(system.corner)])


def _last_of_a_frame(problem: Problem, layout: DenseLayout, num_frames: int) -> VariableType:
    """Return what has the seventh column of each frame.

    As a border, a zoom is as wide as the video is long: every landmark would be coupled with all of it.
    """
    is_zoom = layout.count.get(ZOOM) == num_frames and LOG_SCALE not in layout.count
    reads_scale = any(slot.variable is LOG_SCALE for batch in problem.batches for slot in batch.slots)
    return ZOOM if is_zoom and not reads_scale else LOG_SCALE


def _frame_range(
    problem: Problem, num_frames: int, landmark_free: BoolArray, of_frame: Mapping[VariableType, slice]
) -> tuple[IntArray, IntArray]:
    """Return the first and the last frame that sees each free landmark; last is -1 where none does."""
    first, last = np.full(len(landmark_free), num_frames), np.full(len(landmark_free), -1)
    for batch in problem.batches:
        landmark = next((s.rows for s in batch.slots if s.variable is LANDMARK), None)
        for slot in batch.slots:
            if landmark is not None and slot.variable in of_frame:
                np.minimum.at(first, landmark, slot.rows)
                np.maximum.at(last, landmark, slot.rows)
    last[~landmark_free] = -1
    return first, last


@dataclass(frozen=True)
class _Term:
    """One batch, and where its products go."""

    batch: FactorBatch
    slots: tuple[int, ...]
    groups: tuple[IntArray, IntArray] | None
    """Order of the factors in which those on the same G variables stand together, and where each group begins (G + 1,);
    None where nearly each has its own."""
    gradient: tuple[IntArray, IntArray]
    """Entries of the flattened J^T r (G, D) with a column, and the column; G is N without groups."""
    blocks: dict[str, tuple[IntArray, IntArray]]
    """Per array of the system: entries of the flattened J^T J (G, D, D), and their flat place there."""

    def add_to(self, system: CameraSystem, r: FloatArray, jacobians: list[FloatArray]) -> None:
        """Add J^T J and J^T r of whitened residuals and Jacobians."""
        camera = np.concatenate([jacobians[i] for i in self.slots], axis=2)
        slopes, products = self._products(camera, r)
        entries, places = self.gradient
        np.add.at(system.gradient, places, slopes.reshape(-1)[entries])
        products = products.reshape(-1)
        for name, (entries, places) in self.blocks.items():
            np.add.at(getattr(system, name).reshape(-1), places, products[entries])

    def _products(self, camera: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return J^T r (G, D) and J^T J (G, D, D)."""
        if self.groups is None:
            transposed = np.swapaxes(camera, 1, 2)
            return (transposed @ r[:, :, None])[:, :, 0], transposed @ camera
        order, begin = self.groups
        camera, r, width = camera[order], r[order], camera.shape[2]
        slopes, products = np.empty((len(begin) - 1, width)), np.empty((len(begin) - 1, width, width))
        for group, (first, last) in enumerate(pairwise(begin.tolist())):
            jacobian = camera[first:last].reshape(-1, width)
            slopes[group], products[group] = r[first:last].reshape(-1) @ jacobian, jacobian.T @ jacobian
        return slopes, products


class CameraTerms:
    """Factors on cameras and on what else is not eliminated: few, so that NumPy serves."""

    def __init__(self, batches: list[FactorBatch], columns: CameraColumns):
        """Plan where the products of every batch go; slots without a column, such as landmarks, are passed over."""
        self.batches = batches
        self._terms = [_term(batch, columns) for batch in batches if len(batch)]

    def add_to(self, system: CameraSystem, state: State) -> None:
        """Linearize every batch and add it to the normal equations.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        for term in self._terms:
            if len(term.slots):
                term.add_to(system, *term.batch.linearize(state))

    def add_linearized(self, system: CameraSystem, linearized: Sequence[Linearized]) -> None:
        """Add batches that are linearized already, in their order."""
        for term, (r, jacobians) in zip(self._terms, linearized, strict=True):
            if len(term.slots):
                term.add_to(system, r, jacobians)


def _term(batch: FactorBatch, columns: CameraColumns) -> _Term:
    of_slot = {i: columns.of_slot(s.variable, s.rows) for i, s in enumerate(batch.slots) if columns.has(s.variable)}
    slots = tuple(i for i, at in of_slot.items() if (at >= 0).any())
    width = sum(batch.slots[i].variable.dim for i in slots)
    at = np.concatenate([np.zeros((len(batch), 0), dtype=np.int64), *(of_slot[i] for i in slots)], axis=1)
    groups = None
    if slots:
        rows = np.stack([batch.slots[i].rows for i in slots])
        order = np.lexsort(rows)
        starts = np.flatnonzero(np.diff(rows[:, order], axis=1, prepend=-1).any(axis=0))
        if _GROUPED * len(starts) <= len(batch):
            groups, at = (order, np.append(starts, len(batch))), at[order[starts]]
    row = np.broadcast_to(at[:, :, None], (len(at), width, width)).reshape(-1)
    column = np.broadcast_to(at[:, None, :], (len(at), width, width)).reshape(-1)
    size, stored = columns.size, columns.stored_rows
    known = (row >= 0) & (column >= 0)
    core = np.flatnonzero(known & (row < size) & (column <= row))
    border = np.flatnonzero(known & (row < size) & (column >= size))
    corner = np.flatnonzero(known & (row >= size) & (column >= size))
    blocks = {
        "core": (core, column[core] * stored + row[core] - (column[core] if columns.banded else 0)),
        "border": (border, row[border] * columns.border + column[border] - size),
        "corner": (corner, (row[corner] - size) * columns.border + column[corner] - size),
    }
    used = np.flatnonzero(at.reshape(-1) >= 0)
    return _Term(batch, slots, groups, (used, at.reshape(-1)[used]), {k: v for k, v in blocks.items() if len(v[0])})
