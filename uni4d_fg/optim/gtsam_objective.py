"""A problem whose linear systems GTSAM eliminates: the backend 'gtsam'.

The factors are linearized by GTSAM on its ``Values`` and eliminated by its multifrontal Cholesky; the energy is the
problem's own, so that a step is accepted as by every other backend. Slow, and made for comparison.
"""

from __future__ import annotations

import gtsam
import numpy as np

from uni4d_fg.arrays import BoolArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.gaussian_graph import GraphLinearization, GraphObjective
from uni4d_fg.optim.gtsam_graph import to_gtsam, variables_read
from uni4d_fg.optim.landmark_steps import settle_points
from uni4d_fg.optim.objective import SolvedPart
from uni4d_fg.optim.problem import Problem


class GtsamObjective:
    """A :class:`Problem` on :class:`State` whose linear systems GTSAM solves."""

    def __init__(self, problem: Problem, state: State, config: SolverConfig):
        """Make the factors once.

        Args:
            problem: Batches and free entries.
            state: Values of the frozen variables, and the numbers of the keys of all.
            config: Bounds of the damping diagonal, steps of landmarks alone.
        """
        self.problem, self.config = problem, config
        self._read = variables_read(problem, state)
        graph, _ = to_gtsam(problem, state)
        moves: dict[int, BoolArray] = {}
        for variable, rows in self._read.items():
            wide = np.zeros((len(rows), variable.gtsam_dim or variable.dim), dtype=bool)
            wide[:, _columns(variable)] = problem.free.get(variable, False)
            moves.update(zip(state.keys(variable), wide, strict=True))
        self._graph = GraphObjective(graph, term="graph", config=config, moves=moves)

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        return self.problem.energies(state)

    def linearize(self, state: State) -> GraphLinearization:
        """Linearize every factor.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        return self._graph.linearize(state.to_values(self._read))

    def retract(self, state: State, delta: gtsam.VectorValues) -> State:
        """Return ``state`` moved by ``delta``, landmarks then on alone; frozen entries stay exactly as they are."""
        tangents = {}
        for variable, rows in self.problem.free_rows().items():
            columns = _columns(variable)
            tangent = np.zeros((len(rows), variable.dim))
            moving = rows & self._read.get(variable, np.zeros(len(rows), dtype=bool))
            chosen = np.flatnonzero(moving)
            for row, key in zip(chosen.tolist(), variable.keys(state.numbers(variable)[chosen]), strict=True):
                tangent[row] = delta.at(key)[columns]
            tangents[variable] = np.where(self.problem.free[variable], tangent, 0.0)
        moved, points = state.retract(tangents), self.problem.eliminated
        if points is None or points not in self.problem.free or not self.config.landmark_steps:
            return moved
        free = np.asarray(self.problem.free[points].all(axis=1))
        return settle_points(self.problem.batches, moved, points, free, self.config)

    def parts(self) -> list[SolvedPart]:
        """Return that GTSAM does everything."""
        return [SolvedPart("GTSAM elimination", tuple(dict.fromkeys(b.name for b in self.problem.batches)))]

    def diagnose(self, state: State) -> str:
        """Name the variables that their factors leave undetermined."""
        return self._graph.diagnose(state.to_values(self._read))


def _columns(variable: VariableType) -> list[int]:
    """Return where the entries of a tangent stand in GTSAM's."""
    return list(variable.gtsam_columns) or list(range(variable.dim))
