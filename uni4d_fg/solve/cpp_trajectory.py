"""Inexact Gauss-Newton for many trajectories of points, in C++ (package ``uni4d_fg_cpp``).

The same method as :mod:`uni4d_fg.solve.trajectory_cg`, and the same results up to rounding. Factors are not
multiplied as sparse matrices: distances between neighbours are evaluated once for the two factors that use
them, and the product with J^T J is formed from one direction per distance and one weight per factor.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.arap import ARAP
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import DYNAMIC_DEPTH_PRIOR
from uni4d_fg.factors.dynamic_reprojection import DYNAMIC_REPROJECTION
from uni4d_fg.factors.family import FactorFamily
from uni4d_fg.factors.temporal_smoothness import ACCELERATION_SMOOTHNESS, VELOCITY_SMOOTHNESS
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import State
from uni4d_fg.solve.diagnosis import undetermined, undetermined_message
from uni4d_fg.solve.extension import KERNEL_CODES, import_extension
from uni4d_fg.solve.objective import Step


def _dense(array: Any) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64)


_METHODS: tuple[tuple[FactorFamily, str], ...] = (
    (DYNAMIC_REPROJECTION, "add_dynamic_reprojection"),
    (DYNAMIC_DEPTH_PRIOR, "add_dynamic_depth_prior"),
    (VELOCITY_SMOOTHNESS, "add_smoothness"),
    (ACCELERATION_SMOOTHNESS, "add_smoothness"),
    (ARAP, "add_arap"),
)


def _method(family: FactorFamily) -> str | None:
    """Return the name of the method that takes batches of a family; None when there is none."""
    return next((name for known, name in _METHODS if family == known), None)


def supports(problem: Problem, group: str = "dynamic_point") -> bool:
    """Return whether every batch is of a family that the C++ solver knows, and every point of ``group`` may move."""
    if group not in problem.free or not problem.free[group].all():
        return False
    return all(
        _method(batch.family) is not None and all(s.group == group for s in batch.slots) for batch in problem.batches
    )


class CppTrajectoryObjective:
    """A :class:`Problem` on one group of points ordered by track and frame, all of them free."""

    def __init__(
        self,
        problem: Problem,
        state: State,
        config: SolverConfig,
        group: str = "dynamic_point",
        threads: int | None = None,
    ):
        """Copy the factors and plan their sums once.

        Args:
            problem: Batches that :func:`supports` accepts.
            state: State whose ``names.dynamic_track_frame`` gives the track of each row; rows of one track
                must be consecutive and in the order of their frames.
            config: Tolerance of the inner solve and bounds of the damping diagonal.
            group: The point group.
            threads: Worker threads; the number of cores when None.

        Raises:
            SolverError: If the problem is not supported or a measured value is not finite.
            MissingDependencyError: If the package ``uni4d_fg_cpp`` is not installed.
        """
        core = import_extension()
        if not supports(problem, group):
            raise SolverError(f"the C++ trajectory solver does not take this problem on {group}")
        self.problem, self.config, self.group = problem, config, group
        self.num_points = len(state[group])
        names = state.names.dynamic_track_frame
        track = np.arange(self.num_points) if names is None else np.ascontiguousarray(names[:, 0], dtype=np.int64)
        self._system: Any = core.TrajectorySystem(track, threads or 0)
        self._batches = [batch for batch in problem.batches if len(batch)]
        for batch in self._batches:
            self._append(batch, state)
        self._system.plan()

    def reweight(self, problem: Problem) -> None:
        """Solve ``problem`` from now on, which has the same factors with other weights and kernels.

        Raises:
            SolverError: If its batches are not as many, or not as long.
        """
        batches = [batch for batch in problem.batches if len(batch)]
        if [(b.family, len(b)) for b in batches] != [(b.family, len(b)) for b in self._batches]:
            raise SolverError("reweighting takes the same factors in the same order")
        self.problem, self._batches = problem, batches
        for i, batch in enumerate(batches):
            self._system.reweight(i, _dense(batch.weight), KERNEL_CODES[batch.kernel.kind], batch.kernel.threshold)

    def _append(self, batch: FactorBatch, state: State) -> None:
        name = _method(batch.family)
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
            batch.check(*batch.family.linearize(*batch.gather(state), **batch.data), state)

    def _points(self, state: State) -> FloatArray:
        return _dense(state[self.group])

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        out = {batch.name: 0.0 for batch in self.problem.batches}
        for batch, energy in zip(self._batches, self._system.energies(self._points(state)).tolist(), strict=True):
            out[batch.name] += energy
        return out

    def retract(self, state: State, delta: FloatArray) -> State:
        """Return ``state`` with the points moved by ``delta`` (3 P,)."""
        return state.retract({self.group: delta.reshape(-1, 3)})

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
        return undetermined_message(self.problem, state, [(self.group, row) for row in rows.tolist()])


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
