"""The camera system of bundle adjustment: where its columns stand, and the few factors that read no landmark.

The core holds the free entries of pose and log-scale frame by frame, so that frames which share no landmark
leave it banded; the shared intrinsics are its border. Storage is LAPACK's lower triangle, one row of the array
per column: entry (i, j), i >= j, stands at ``[j, i]`` of a dense core and at ``[j, i - j]`` of a banded one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import TANGENT_DIM, State
from uni4d_fg.solve.layout import DenseLayout

BORDER = 4
_BAND_FRACTION = 0.4
"""A core is stored as a band if the band is narrower than this part of its size."""


@dataclass
class CameraSystem:
    """Normal equations, or a reduced system, of the cameras."""

    core: FloatArray
    """(n, stored rows)."""
    border: FloatArray
    """(n, 4)."""
    corner: FloatArray
    """(4, 4)."""
    gradient: FloatArray
    """(n + 4,) gradient, or right-hand side of a reduced system."""


@dataclass(frozen=True)
class CameraColumns:
    """The order of the camera system's columns, and its storage."""

    core: IntArray
    """(T, 7) core column of each pose entry and log-scale; -1 if frozen."""
    layout_columns: IntArray
    """(n + 4,) column in the dense layout of each column; -1 for frozen intrinsics."""
    size: int
    """Core columns n."""
    stored_rows: int
    banded: bool

    @classmethod
    def create(cls, problem: Problem, layout: DenseLayout, num_frames: int, landmark_free: BoolArray) -> CameraColumns:
        """Order the columns and measure how far apart frames that share a factor or a free landmark are."""
        free = np.zeros((num_frames, 7), dtype=bool)
        in_layout = np.full((num_frames, 7), -1)
        for group, columns in (("pose", slice(0, 6)), ("log_scale", slice(6, 7))):
            if group in layout.offset:
                in_layout[:, columns] = layout.columns(group, np.arange(num_frames))
                free[:, columns] = layout.free[in_layout[:, columns]]
        core = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
        border = np.full(BORDER, -1)
        if "intrinsics" in layout.offset:
            border = layout.columns("intrinsics", np.arange(1))[0]
            border = np.where(layout.free[border], border, -1)
        size = int(free.sum())
        end = np.cumsum(free.sum(axis=1))
        start = end - free.sum(axis=1)
        width = int((end - start).max(initial=0))
        first, last = _frame_range(problem, num_frames, landmark_free)
        seen = last >= 0
        width = max(width, int((end[last[seen]] - start[first[seen]]).max(initial=0)))
        for batch in problem.batches:
            frames = [s.rows for s in batch.slots if s.group in ("pose", "log_scale") and s.group in layout.offset]
            if frames and len(batch):
                width = max(width, int((end[np.max(frames, axis=0)] - start[np.min(frames, axis=0)]).max()))
        banded = width < _BAND_FRACTION * size
        return cls(core, np.r_[in_layout[free], border], size, width if banded else size, banded)

    def of_slot(self, group: str, rows: IntArray) -> IntArray:
        """Return the columns (N, dim) of rows (N,) of a group; border columns from n on; -1 if frozen."""
        if group == "pose":
            return self.core[rows, :6]
        if group == "log_scale":
            return self.core[rows, 6:]
        column = np.where(self.layout_columns[self.size :] >= 0, self.size + np.arange(BORDER), -1)
        return np.broadcast_to(column, (len(rows), BORDER))

    def diagonal(self, system: CameraSystem) -> FloatArray:
        """Return the diagonal of core and corner, (n + 4,)."""
        index = np.arange(self.size)
        core = system.core[:, 0] if self.banded and self.size else system.core[index, index]
        return np.concatenate([core, np.diag(system.corner)])


def _frame_range(problem: Problem, num_frames: int, landmark_free: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first and the last frame that sees each free landmark; last is -1 where none does."""
    first, last = np.full(len(landmark_free), num_frames), np.full(len(landmark_free), -1)
    for batch in problem.batches:
        rows = {s.group: s.rows for s in batch.slots}
        if "landmark" in rows and "pose" in rows:
            np.minimum.at(first, rows["landmark"], rows["pose"])
            np.maximum.at(last, rows["landmark"], rows["pose"])
    last[~landmark_free] = -1
    return first, last


@dataclass(frozen=True)
class _Term:
    """One batch, and where its products go."""

    batch: FactorBatch
    slots: tuple[int, ...]
    gradient: tuple[IntArray, IntArray]
    """Entries of the flattened J^T r (N, D) with a column, and the column."""
    blocks: dict[str, tuple[IntArray, IntArray]]
    """Per array of the system: entries of the flattened J^T J (N, D, D), and their flat place there."""


class CameraTerms:
    """Factors on cameras alone: few, so that NumPy serves."""

    def __init__(self, batches: list[FactorBatch], columns: CameraColumns):
        """Plan where the products of every batch go."""
        self.batches = batches
        self._terms = [_term(batch, columns) for batch in batches if len(batch)]

    def add_to(self, system: CameraSystem, state: State) -> None:
        """Linearise every batch and add it to the normal equations.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        for term in self._terms:
            if not len(term.slots):
                continue
            r, jacobians = term.batch.linearize(state)
            camera = np.concatenate([jacobians[i] for i in term.slots], axis=2)
            transposed = np.swapaxes(camera, 1, 2)
            entries, places = term.gradient
            np.add.at(system.gradient, places, (transposed @ r[:, :, None]).reshape(-1)[entries])
            products = (transposed @ camera).reshape(-1)
            for name, (entries, places) in term.blocks.items():
                np.add.at(getattr(system, name).reshape(-1), places, products[entries])


def _term(batch: FactorBatch, columns: CameraColumns) -> _Term:
    groups = ("pose", "log_scale", "intrinsics")
    of_slot = {i: columns.of_slot(s.group, s.rows) for i, s in enumerate(batch.slots) if s.group in groups}
    slots = tuple(i for i, at in of_slot.items() if (at >= 0).any())
    width = sum(TANGENT_DIM[batch.slots[i].group] for i in slots)
    at = np.concatenate([np.zeros((len(batch), 0), dtype=np.int64), *(of_slot[i] for i in slots)], axis=1)
    row = np.broadcast_to(at[:, :, None], (len(batch), width, width)).reshape(-1)
    column = np.broadcast_to(at[:, None, :], (len(batch), width, width)).reshape(-1)
    size, stored = columns.size, columns.stored_rows
    known = (row >= 0) & (column >= 0)
    core = np.flatnonzero(known & (row < size) & (column <= row))
    border = np.flatnonzero(known & (row < size) & (column >= size))
    corner = np.flatnonzero(known & (row >= size) & (column >= size))
    blocks = {
        "core": (core, column[core] * stored + row[core] - (column[core] if columns.banded else 0)),
        "border": (border, row[border] * BORDER + column[border] - size),
        "corner": (corner, (row[corner] - size) * BORDER + column[corner] - size),
    }
    used = np.flatnonzero(at.reshape(-1) >= 0)
    return _Term(batch, slots, (used, at.reshape(-1)[used]), {k: v for k, v in blocks.items() if len(v[0])})
