"""Stages of a window under the numbers that frames and tracks have in the whole video."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import IntArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.optim.summary import SolveSummary


@dataclass(frozen=True)
class NumberedRunner:
    """A ``StageRunner`` for stages that count frames and tracks from a window's first.

    Another one solves them under keys of the whole video, so that what is added, kept or said of a variable means the
    same in every window; the state comes back under the window's own.
    """

    run: StageRunner
    frame: IntArray
    """(F,) number of each of the window's frames in the video."""
    track: IntArray | None = None
    """(K,) number of each of its tracks; None where they have that of the video already."""
    own_world: bool = True
    """Whether the stages' world begins at the window's first camera."""

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage."""
        index = {variable: self._numbers(variable, state) for variable in state.arrays}
        solved, summary = self.run(replace(stage, own_world=self.own_world), State(state.arrays, index), hooks)
        return State(solved.arrays, state.index), summary

    def _numbers(self, variable: VariableType, state: State) -> IntArray:
        numbers = np.array(state.numbers(variable))
        for column, name in enumerate(variable.index):
            if name == "frame":
                numbers[:, column] = self.frame[numbers[:, column]]
            elif name == "track" and self.track is not None:
                numbers[:, column] = self.track[numbers[:, column]]
        return numbers
