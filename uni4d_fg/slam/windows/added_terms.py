"""Added factors in the join of windows: each counts once, whatever windows it lies in or between.

In the windows' own solves relative measurements are added too, so that these end near the right scale; what a window
tells the join has nothing of them. Here all frames are in one world: absolute measurements join here, and relative ones
between frames of different windows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.priors import log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.added_factors import AddingRunner, JoinedStage
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.fronts import Entries
from uni4d_fg.slam.windows.information import FRAME


@dataclass
class AddedTerms:
    """Factors on the cameras of all windows and on variables of their own."""

    joined: JoinedStage
    state: State
    """Present values; those of the cameras are given anew."""
    num_frames: int

    @property
    def is_metric(self) -> bool:
        """Whether they hold the scale of the world."""
        return self.joined.is_metric

    @property
    def size(self) -> int:
        """Number of columns."""
        own = sum(len(self.state[variable]) * variable.dim for variable in self.joined.added)
        return FRAME * self.num_frames + 4 + own

    @property
    def free(self) -> BoolArray:
        """(size,) what may move."""
        out = np.zeros(self.size, dtype=bool)
        for variable, mask in self.joined.stage.problem.free.items():
            out[self.columns(variable, np.arange(len(mask)))] = mask
        return out

    def columns(self, variable: VariableType, rows: IntArray) -> IntArray:
        """Return the columns (..., dim) of rows (...) of a variable.

        Raises:
            SolverError: If an added factor reads a variable that the join does not have.
        """
        if variable is POSE:
            return FRAME * rows[..., None] + np.arange(6)
        if variable is LOG_SCALE:
            return FRAME * rows[..., None] + 6
        start = FRAME * self.num_frames
        if variable is INTRINSICS:
            return start + rows[..., None] * 0 + np.arange(4)
        start += 4
        for other in self.joined.added:
            if other is variable:
                return start + rows[..., None] * variable.dim + np.arange(variable.dim)
            start += len(self.state[other]) * other.dim
        raise SolverError(
            f"an added factor reads {variable} variables in the join of windows, where only cameras are solved; let "
            "its source return None where stage.part is 'join'"
        )

    def _rows(self, cameras: Cameras) -> Iterator[tuple[FloatArray, list[tuple[IntArray, FloatArray]]]]:
        """Yield per batch the whitened residuals (N, d), and columns (N, dim) and Jacobians (N, d, dim) per slot."""
        self.state = self.state.replace({v: a for v, a in _state(cameras).arrays.items()})
        for batch in self.joined.stage.problem.batches:
            if len(batch):
                r, jacobians = batch.linearize(self.state)
                yield r, [(self.columns(s.variable, s.rows), j) for s, j in zip(batch.slots, jacobians, strict=True)]

    def linearize(self, cameras: Cameras) -> tuple[FloatArray, list[Entries]]:
        """Return the gradient (size,) and the entries of the Hessian."""
        gradient, entries = np.zeros(self.size), []
        for r, slots in self._rows(cameras):
            for rows, left in slots:
                np.add.at(gradient, rows, np.einsum("nda,nd->na", left, r))
                for columns, right in slots:
                    block = np.swapaxes(left, 1, 2) @ right
                    row = np.broadcast_to(rows[:, :, None], block.shape)
                    column = np.broadcast_to(columns[:, None, :], block.shape)
                    entries.append((row.reshape(-1), column.reshape(-1), block.reshape(-1)))
        return gradient, entries

    def move(self, step: FloatArray) -> None:
        """Move the added variables along a step (size,)."""
        self.state = self.state.retract(
            {v: step[self.columns(v, np.arange(len(self.state[v])))] for v in self.joined.added}
        )

    def keep(self, run: StageRunner) -> None:
        """Let the next round start at the present values."""
        if isinstance(run, AddingRunner):
            run.known.take(self.state, self.joined.added)


def added_terms(run: AddingRunner, cameras: Cameras, config: Config) -> AddedTerms:
    """Ask the sources of a run for the join, part 'join' of bundle adjustment: the cameras of all frames, no landmarks.

    The priors on the frames' log-scales are among the terms; the windows must not have them.

    Raises:
        SolverError: If a source declares a variable that the stage has, or a factor does not fit.
    """
    state, num_frames = _state(cameras), len(cameras.world_T_cam)
    problem = Problem.over(state).fix(POSE, rows=[0]).fix(INTRINSICS).fix(LANDMARK)
    sigma = config.bundle_adjustment.depth_scale_prior_sigma
    problem.add(log_scale_prior(np.arange(num_frames), measured=np.zeros((num_frames, 1)), sigma=sigma))
    joined = run.joined(Stage("bundle_adjustment", problem, config.bundle_adjustment.solver, part="join"), state)
    return AddedTerms(joined, joined.state, num_frames)


def _state(cameras: Cameras) -> State:
    return cameras.state(np.zeros((0, 3)), np.zeros(0, dtype=np.int64))
