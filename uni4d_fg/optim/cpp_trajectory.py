"""Inexact Gauss-Newton for many trajectories of points, in C++ (package ``uni4d_fg_cpp``).

The same method as :mod:`uni4d_fg.optim.trajectory_cg`, and the same results up to rounding. Factors are not
multiplied as sparse matrices: distances between neighbors are evaluated once for the two factors that use
them, and the product with J^T J is formed from one direction per distance and one weight per factor. Factors of other
types on the points take part as linearized blocks.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import dynamic_depth_prior
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.state import State
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness, velocity_smoothness
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.optim.diagnosis import undetermined, undetermined_message
from uni4d_fg.optim.extension import KERNEL_CODES, batch_energy, import_extension
from uni4d_fg.optim.objective import SolvedPart, Step
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.threads import thread_count


def _dense(array: Any) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64)


_METHODS: tuple[tuple[FactorType, str], ...] = (
    (dynamic_reprojection, "add_dynamic_reprojection"),
    (dynamic_depth_prior, "add_dynamic_depth_prior"),
    (velocity_smoothness, "add_smoothness"),
    (acceleration_smoothness, "add_smoothness"),
    (arap, "add_arap"),
)
"""The factor types that the C++ system evaluates itself; all others are handed over linearized."""
_MOST_SLOTS, _MOST_RESIDUALS = 8, 16


def _method(factor_type: FactorType) -> str | None:
    return next((name for known, name in _METHODS if factor_type is known), None)


def refusal(problem: Problem, variable: VariableType = DYNAMIC_POINT) -> str:
    """Return why the C++ trajectory solver does not take a problem; empty if it does."""
    if variable not in problem.free or not problem.free[variable].all():
        return f"some {variable} variables are frozen"
    for batch in problem.batches:
        if any(s.variable is not variable for s in batch.slots):
            return f"{batch.name} reads other variables than {variable}"
        if _method(batch.factor_type) is None and (
            len(batch.slots) > _MOST_SLOTS or batch.factor_type.dim > _MOST_RESIDUALS
        ):
            return f"{batch.name} has more than {_MOST_SLOTS} variables or {_MOST_RESIDUALS} residuals"
    return ""


class CppTrajectoryObjective:
    """A :class:`Problem` on one variable of points ordered by track and frame, all of them free."""

    def __init__(
        self,
        problem: Problem,
        state: State,
        config: SolverConfig,
        variable: VariableType = DYNAMIC_POINT,
        threads: int | None = None,
    ):
        """Copy the factors and plan their sums once.

        Args:
            problem: Batches that :func:`refusal` says nothing against.
            state: State whose ``names.dynamic_track_frame`` gives the track of each row; rows of one track
                must be consecutive and in the order of their frames.
            config: Tolerance of the inner solve and bounds of the damping diagonal.
            variable: The point variable.
            threads: Worker threads; the number of cores when None.

        Raises:
            SolverError: If the problem is not supported or a measured value is not finite.
            MissingDependencyError: If the package ``uni4d_fg_cpp`` is not installed.
        """
        core = import_extension()
        if reason := refusal(problem, variable):
            raise SolverError(f"the C++ trajectory solver does not take this problem: {reason}")
        self.problem, self.config, self.variable = problem, config, variable
        self.num_points = len(state[variable])
        track = np.ascontiguousarray(state.numbers(variable)[:, 0])
        self._system: Any = core.TrajectorySystem(track, thread_count(threads))
        self._batches = [batch for batch in problem.batches if len(batch)]
        self._index: dict[int, int] = {}
        """Index in the system of every batch that is handed over linearized, by its place."""
        for place, batch in enumerate(self._batches):
            if _method(batch.factor_type) is None:
                rows = [np.ascontiguousarray(s.rows, dtype=np.int64) for s in batch.slots]
                self._index[place] = self._system.add_linearized(rows, batch.factor_type.dim)
            else:
                self._append(batch, state)
        self._system.plan()

    def reweight(self, problem: Problem) -> None:
        """Solve ``problem`` from now on, which has the same factors with other weights and kernels.

        Raises:
            SolverError: If its batches are not as many, or not as long.
        """
        batches = [batch for batch in problem.batches if len(batch)]
        if [(b.factor_type, len(b)) for b in batches] != [(b.factor_type, len(b)) for b in self._batches]:
            raise SolverError("reweighting takes the same factors in the same order")
        self.problem, self._batches = problem, batches
        for i, batch in enumerate(batches):
            if i in self._index:
                continue
            self._system.reweight(i, _dense(batch.weight), KERNEL_CODES[batch.kernel.kind], batch.kernel.threshold)

    def _append(self, batch: FactorBatch, state: State) -> None:
        name = _method(batch.factor_type)
        assert name is not None
        try:
            getattr(self._system, name)(
                rows=[np.ascontiguousarray(s.rows, dtype=np.int64) for s in batch.slots],
                **{name: _dense(array) for name, array in batch.data.items()},
                sigma=_dense(batch.sigma),
                weight=_dense(batch.weight),
                kernel=KERNEL_CODES[batch.kernel.kind],
                threshold=batch.kernel.threshold,
            )
        except ValueError as error:
            self._blame(batch, state)
            raise SolverError(f"{batch.name}: {error}") from error

    @staticmethod
    def _blame(batch: FactorBatch, state: State) -> None:
        """Raise the error that names the factor of a batch that is not finite at ``state``, if one is."""
        with np.errstate(all="ignore"):
            batch.check(*batch.factor_type.linearize(*batch.gather(state), **batch.data), state)

    def _points(self, state: State) -> FloatArray:
        return _dense(state[self.variable])

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        out = {batch.name: 0.0 for batch in self.problem.batches}
        own = self._system.energies(self._points(state)).tolist()
        for place, (batch, energy) in enumerate(zip(self._batches, own, strict=True)):
            out[batch.name] += batch_energy(batch, state) if place in self._index else energy
        return out

    def parts(self) -> list[SolvedPart]:
        """Return which factors are linearized by what."""
        own = [b.name for i, b in enumerate(self._batches) if i not in self._index]
        foreign = [self._batches[i].name for i in self._index]
        return [
            SolvedPart("C++ trajectories", tuple(dict.fromkeys(own))),
            SolvedPart("linearized blocks in the C++ trajectories", tuple(dict.fromkeys(foreign))),
        ]

    def retract(self, state: State, delta: FloatArray) -> State:
        """Return ``state`` with the points moved by ``delta`` (3 P,)."""
        return state.retract({self.variable: delta.reshape(-1, 3)})

    def linearize(self, state: State) -> CppTrajectoryLinearization:
        """Return the gradient and J^T J at ``state``; they are valid until the next call.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        return self._linearize(state, 0.0)

    def linearize_curved(self, state: State) -> CppTrajectoryLinearization:
        """Return the same with the part ``kernel_curvature`` of the kernels' curvature."""
        return self._linearize(state, self.config.kernel_curvature)

    def _linearize(self, state: State, kernel_curvature: float) -> CppTrajectoryLinearization:
        for place, index in self._index.items():
            r, jacobians = self._batches[place].linearize(state, kernel_curvature)
            self._system.set_linearized(index, _dense(r), _dense(np.stack(jacobians, axis=2)))
        gradient, failure = self._system.linearize(self._points(state), kernel_curvature)
        if failure is not None:
            batch = self._batches[failure[0]]
            self._blame(batch, state)
            raise SolverError(f"{batch.name}: a factor is too large, on {batch.describe_row(failure[1], state)}")
        return CppTrajectoryLinearization(self.config, self._system, gradient)

    def diagnose(self, state: State) -> str:
        """Name the points that no factor determines."""
        self.linearize(state)
        rows = undetermined(self._system.diagonal_blocks())
        return undetermined_message(self.problem, state, [(self.variable, row) for row in rows.tolist()])


class CppTrajectoryLinearization:
    """The gradient, J^T J as a product, and its per-track blocks, at one point."""

    def __init__(self, config: SolverConfig, system: Any, gradient: FloatArray):
        """Store the gradient (3 P,); the blocks stay in ``system``."""
        self.config, self.gradient, self._system = config, gradient, system

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient."""
        return float(np.abs(self.gradient).max(initial=0.0))

    def multiply(self, vector: FloatArray) -> FloatArray:
        """Return (J^T J) ``vector``, (3 P,)."""
        result: FloatArray = self._system.multiply(_dense(vector))
        return result

    def solve(self, damping: float) -> Step | None:
        """Return the inexact step, or None when the preconditioner is not positive definite."""
        config = self.config
        result = self._system.solve(
            damping, config.min_diagonal, config.max_diagonal, config.cg_tolerance, config.cg_max_iterations
        )
        return None if result is None else Step(*result)
