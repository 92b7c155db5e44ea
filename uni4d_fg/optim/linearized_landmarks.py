r"""Factors of any type on landmarks, for the C++ landmark solver: handed over as linearized blocks.

The C++ system keeps E (landmarks with frames), V and g_l. What other factors add to these goes into it: storage for
their pairs of frame and landmark is planned with a batch of weight 0. What couples landmarks with any other variable,
call it F, stays here, and the reduced system is corrected by the products that the C++ elimination does not know,

    (E + F) V^{-1} (E + F)^T - E V^{-1} E^T = E V^{-1} F^T + F V^{-1} E^T + F V^{-1} F^T,

with rows L^{-1} E^T that C++ returns (V = L L^T, damped) and dense F over the columns that the factors touch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import LANDMARK
from uni4d_fg.optim.camera_terms import CameraColumns, CameraSystem, CameraTerms
from uni4d_fg.optim.extension import linearize_batch

_CHUNK = 256
"""Landmarks corrected together: their rows of E^T fit the cache."""


@dataclass(frozen=True)
class _Coupled:
    """One batch, and where its products with the Jacobians of its landmarks go; n of its factors have a free one."""

    slot: int
    """Of the landmark."""
    moving: IntArray | None
    """The n factors; None if that is all of them."""
    rows: IntArray
    """(n,) landmarks."""
    frames: list[tuple[IntArray, list[tuple[int, slice]]]]
    """Frames (n,), the slots that have columns of these, and which of the seven."""
    others: list[_Spread]

    def of(self, array: FloatArray) -> FloatArray:
        """Return what the factors have (N, ...) of the n with a free landmark."""
        return array if self.moving is None else array[self.moving]


@dataclass(frozen=True)
class _Spread:
    """A slot of a variable that E has no columns for: its products, summed by landmark and row of the variable."""

    slot: int
    order: IntArray | None
    """(n,) the factors, those with one sum together; None if they are."""
    begin: IntArray
    """(G,) where each of the sums begins."""
    landmark: IntArray
    """(G,) place among the landmarks that are coupled."""
    column: IntArray
    """(G, dim) place among the columns that are touched; the one behind them where frozen."""

    def add_to(self, coupling: FloatArray, product: FloatArray) -> None:
        """Add products (n, 3, dim) to the coupling (L, 3, columns + 1)."""
        ordered = product if self.order is None else product[self.order]
        sums = np.add.reduceat(ordered, self.begin, axis=0)
        # A sum has a landmark and columns of its own, but for those that are frozen.
        coupling[self.landmark[:, None, None], np.arange(3)[:, None], self.column[:, None, :]] += sums


class LinearizedLandmarks:
    """Foreign factors that read a landmark each, and what they add to the normal equations."""

    def __init__(self, batches: list[FactorBatch], columns: CameraColumns, landmark_free: BoolArray):
        """Plan which landmarks and columns they touch."""
        self.batches, self.columns, self.free = batches, columns, landmark_free
        self._cameras = CameraTerms(batches, columns)
        of_landmark = [next(i for i, s in enumerate(b.slots) if s.variable is LANDMARK) for b in batches]
        places, touched = [], [np.zeros(0, dtype=np.int64)]
        for batch, i in zip(batches, of_landmark, strict=True):
            others = [s for s in batch.slots if columns.has(s.variable) and s.variable not in columns.of_frame]
            places += [columns.of_slot(s.variable, s.rows).reshape(-1) for s in others]
            touched += [np.unique(batch.slots[i].rows)] if others else []
        landmarks = np.unique(np.concatenate(touched))
        self.landmarks: IntArray = landmarks[landmark_free[landmarks]]
        """Those that are coupled with a variable that is not of a frame."""
        used = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *places]))
        self._columns: IntArray = used[used >= 0]
        self._coupled = [self._plan(batch, slot) for batch, slot in zip(batches, of_landmark, strict=True)]
        self._coupling: FloatArray = np.zeros((0, 3, 0))

    def _plan(self, batch: FactorBatch, slot: int) -> _Coupled:
        free = self.free[batch.slots[slot].rows]
        moving = None if free.all() else np.flatnonzero(free)
        at = slice(None) if moving is None else moving
        rows = np.ascontiguousarray(batch.slots[slot].rows[at], dtype=np.int64)
        frames: list[tuple[IntArray, list[tuple[int, slice]]]] = []
        others: list[_Spread] = []
        for i, s in enumerate(batch.slots):
            if not self.columns.has(s.variable):
                continue
            own = np.ascontiguousarray(s.rows[at], dtype=np.int64)
            if s.variable not in self.columns.of_frame:
                if len(rows):
                    others.append(self._spread(i, s.variable, rows, own))
                continue
            place = self.columns.of_frame[s.variable]
            same = next((slots for known, slots in frames if np.array_equal(known, own)), None)
            if same is None or any(place == taken for _, taken in same):
                frames.append((own, [(i, place)]))
            else:
                same.append((i, place))
        return _Coupled(slot, moving, rows, frames, others)

    def _spread(self, slot: int, variable: VariableType, landmarks: IntArray, rows: IntArray) -> _Spread:
        order = np.lexsort((rows, landmarks))
        is_ordered = bool(np.all(order[1:] > order[:-1]))
        changes = (np.diff(landmarks[order]) != 0) | (np.diff(rows[order]) != 0)
        begin = np.concatenate(([0], 1 + np.flatnonzero(changes)))
        first = order[begin]
        column = self.columns.of_slot(variable, rows[first])
        place = np.where(column >= 0, np.searchsorted(self._columns, column), len(self._columns))
        return _Spread(
            slot, None if is_ordered else order, begin, np.searchsorted(self.landmarks, landmarks[first]), place
        )

    def add_to(self, core: Any, system: CameraSystem, state: State) -> float:
        """Linearize, add to the camera system and to the landmarks of ``core``; return the largest gradient entry.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        linearized = [linearize_batch(batch, state) for batch in self.batches]
        self._cameras.add_linearized(system, linearized)
        # One column more than the factors touch, for entries that are frozen.
        coupling = np.zeros((len(self.landmarks), 3, len(self._columns) + 1))
        largest = 0.0
        for coupled, (r, jacobians) in zip(self._coupled, linearized, strict=True):
            of_landmark = coupled.of(jacobians[coupled.slot])
            point = np.ascontiguousarray(np.swapaxes(of_landmark, 1, 2))
            largest = core.add_to_landmarks(
                coupled.rows, point @ of_landmark, (point @ coupled.of(r)[:, :, None])[:, :, 0]
            )
            for frames, slots in coupled.frames:
                of_frame = np.zeros((len(frames), point.shape[2], 7))
                for slot, place in slots:
                    of_frame[:, :, place] = coupled.of(jacobians[slot])
                core.add_to_coupling(frames, coupled.rows, point @ of_frame)
            for other in coupled.others:
                other.add_to(coupling, point @ coupled.of(jacobians[other.slot]))
        self._coupling = coupling[:, :, :-1]
        return largest

    def pairs(self) -> tuple[IntArray, IntArray]:
        """Return the frames (P,) and landmarks (P,) that the factors couple, each pair once."""
        found, count = [np.zeros(0, dtype=np.int64)], max(len(self.free), 1)
        for batch, coupled in zip(self.batches, self._coupled, strict=True):
            landmark = batch.slots[coupled.slot].rows
            found += [s.rows * count + landmark for s in batch.slots if s.variable in self.columns.of_frame]
        frames, landmarks = np.divmod(np.unique(np.concatenate(found)), count)
        return frames, landmarks

    def correct(self, core: Any, reduced: CameraSystem) -> None:
        """Correct a reduced system in place for the coupling that ``core`` does not know."""
        if not self._coupling.shape[2] or not self._coupling.any():
            return
        columns = self.columns
        size = columns.size + 4  # what core knows: the core and the intrinsics
        known = np.arange(size)
        for start in range(0, len(self.landmarks), _CHUNK):
            rows = self.landmarks[start : start + _CHUNK]
            own = core.whitened_coupling(rows).reshape(3 * len(rows), -1)
            other = core.inverse_factors(rows) @ self._coupling[start : start + _CHUNK]
            other = other.reshape(3 * len(rows), -1)
            cross, both = own[:, :size].T @ other, other.T @ other
            reduced.subtract(known, self._columns, cross, columns.banded)
            reduced.subtract(self._columns, known, cross.T, columns.banded)
            reduced.subtract(self._columns, self._columns, both, columns.banded)
            reduced.gradient[self._columns] += other.T @ own[:, -1]

    def along(self, camera_step: FloatArray, num_landmarks: int) -> FloatArray | None:
        """Return F^T d, (N, 3), for the back-substitution; None where nothing is coupled."""
        if not len(self.landmarks):
            return None
        out = np.zeros((num_landmarks, 3))
        out[self.landmarks] = self._coupling @ camera_step[self._columns]
        return out
