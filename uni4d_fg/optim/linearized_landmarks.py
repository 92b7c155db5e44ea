r"""Factors of any type on landmarks, for the C++ landmark solver: handed over as linearized blocks.

The C++ system keeps E (landmarks with frames), V and g_l. What other factors add to these goes into it: storage for
their pairs of frame and landmark is planned with a batch of weight 0. What couples landmarks with any other variable,
call it F, stays here, and the reduced system is corrected by the products that the C++ elimination does not know,

    (E + F) V^{-1} (E + F)^T - E V^{-1} E^T = E V^{-1} F^T + F V^{-1} E^T + F V^{-1} F^T,

with rows L^{-1} E^T that C++ returns (V = L L^T, damped) and dense F over the columns that the factors touch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.camera_terms import CameraColumns, CameraSystem, CameraTerms
from uni4d_fg.optim.extension import linearize_batch

_OF_A_FRAME = {POSE: slice(0, 6), LOG_SCALE: slice(6, 7)}
"""Variables that E has columns for, of the seven of a frame."""
_CHUNK = 256
"""Landmarks corrected together: their rows of E^T fit the cache."""


class LinearizedLandmarks:
    """Foreign factors that read a landmark each, and what they add to the normal equations."""

    def __init__(self, batches: list[FactorBatch], columns: CameraColumns, landmark_free: BoolArray):
        """Plan which landmarks and columns they touch."""
        self.batches, self.columns, self.free = batches, columns, landmark_free
        self._cameras = CameraTerms(batches, columns)
        self._slot = [next(i for i, s in enumerate(b.slots) if s.variable is LANDMARK) for b in batches]
        places, touched = [], [np.zeros(0, dtype=np.int64)]
        for batch, i in zip(batches, self._slot, strict=True):
            others = [s for s in batch.slots if columns.has(s.variable) and s.variable not in _OF_A_FRAME]
            places += [columns.of_slot(s.variable, s.rows).reshape(-1) for s in others]
            touched += [np.unique(batch.slots[i].rows)] if others else []
        landmarks = np.unique(np.concatenate(touched))
        self.landmarks: IntArray = landmarks[landmark_free[landmarks]]
        """Those that are coupled with a variable that is not of a frame."""
        used = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *places]))
        self._columns: IntArray = used[used >= 0]
        self._coupling: FloatArray = np.zeros((0, 3, 0))

    def add_to(self, core: Any, system: CameraSystem, state: State) -> float:
        """Linearize, add to the camera system and to the landmarks of ``core``; return the largest gradient entry.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        linearized = [linearize_batch(batch, state) for batch in self.batches]
        self._cameras.add_linearized(system, linearized)
        # One column more than the factors touch, for entries that are frozen.
        width = len(self._columns) + 1
        coupling = np.zeros(len(self.landmarks) * 3 * width)
        largest = 0.0
        for batch, slot, (r, jacobians) in zip(self.batches, self._slot, linearized, strict=True):
            moving = np.flatnonzero(self.free[batch.slots[slot].rows])
            rows = np.ascontiguousarray(batch.slots[slot].rows[moving], dtype=np.int64)
            point = np.swapaxes(jacobians[slot][moving], 1, 2)
            largest = core.add_to_landmarks(
                rows, np.ascontiguousarray(point @ jacobians[slot][moving]), (point @ r[moving][:, :, None])[:, :, 0]
            )
            for i, s in enumerate(batch.slots):
                if not self.columns.has(s.variable):
                    continue
                product = point @ jacobians[i][moving]
                if s.variable in _OF_A_FRAME:
                    of_frame = np.zeros((len(rows), 3, 7))
                    of_frame[:, :, _OF_A_FRAME[s.variable]] = product
                    core.add_to_coupling(np.ascontiguousarray(s.rows[moving], dtype=np.int64), rows, of_frame)
                    continue
                column = self.columns.of_slot(s.variable, s.rows[moving])
                place = np.where(column >= 0, np.searchsorted(self._columns, column), width - 1)
                row = 3 * np.searchsorted(self.landmarks, rows)[:, None, None] + np.arange(3)[:, None]
                entry = row * width + place[:, None, :]
                coupling += np.bincount(entry.reshape(-1), product.reshape(-1), len(coupling))
        self._coupling = coupling.reshape(-1, 3, width)[:, :, :-1]
        return largest

    def pairs(self) -> tuple[IntArray, IntArray]:
        """Return the frames (P,) and landmarks (P,) that the factors couple, each pair once."""
        found, count = [np.zeros(0, dtype=np.int64)], max(len(self.free), 1)
        for batch, slot in zip(self.batches, self._slot, strict=True):
            landmark = batch.slots[slot].rows
            found += [s.rows * count + landmark for s in batch.slots if s.variable in _OF_A_FRAME]
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
