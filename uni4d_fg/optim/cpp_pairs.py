"""Poses from depth reprojection, in C++: the normal equations of camera initialization.

The factors of a frame pair share their relative pose, so that each adds to one small block of its pair and the
pair is spread over both poses at the end. Only free entries have a column: a window of a long video is a
small dense system. The few factors of other families (camera motion, priors) are added as rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import lapack

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_reprojection import depth_reprojection
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import INTRINSICS, POSE
from uni4d_fg.optim.extension import KERNEL_CODES, batch_energy, has_kernel, import_extension, linearize_batch
from uni4d_fg.optim.objective import SolvedPart, Step
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective
from uni4d_fg.optim.threads import thread_count

_MOST_COLUMNS = 2000
"""Free entries above which a dense system is no longer the better choice."""
_MOST_OTHER_ROWS = 2000
"""Factors of other families above which adding them row by row costs too much."""


def refusal(problem: Problem) -> str:
    """Return why the C++ solver of frame pairs does not take a problem; empty if it does.

    It takes depth reprojection with one camera, and little besides, of whatever type.
    """
    if problem.eliminated is not None and problem.is_free(problem.eliminated):
        return f"{problem.eliminated} variables are eliminated"
    pairs = [batch for batch in problem.batches if batch.factor_type is depth_reprojection]
    others = [batch for batch in problem.batches if batch.factor_type is not depth_reprojection]
    if not any(len(batch) for batch in pairs):
        return "there is no depth reprojection"
    if sum(len(batch) for batch in others) > _MOST_OTHER_ROWS:
        return f"more than {_MOST_OTHER_ROWS} factors are not depth reprojection"
    if sum(int(mask.sum()) for mask in problem.free.values()) > _MOST_COLUMNS:
        return f"more than {_MOST_COLUMNS} entries are free"
    if any(batch.slots[2].rows.any() for batch in pairs):
        return "there is more than one camera"
    return ""


@dataclass(frozen=True)
class _OtherRows:
    """A batch of another family and the columns (N, dim) of its slots; the last column takes frozen entries."""

    batch: FactorBatch
    columns: list[IntArray | None]


class CppPairObjective:
    """A :class:`Problem` of depth reprojection whose normal equations are accumulated in C++."""

    def __init__(self, problem: Problem, state: State, config: SolverConfig, threads: int | None = None):
        """Group the factors by frame pair once.

        Args:
            problem: A problem that :func:`refusal` says nothing against.
            state: Any state of the problem (only array lengths are read).
            config: Bounds of the damping diagonal.
            threads: Worker threads; the number of cores when None.

        Raises:
            MissingDependencyError: If the extension is not installed.
            SolverError: If a measured value is not finite; names its variables.
        """
        core = import_extension()
        self.problem, self.config = problem, config
        self.columns: dict[VariableType, IntArray] = {}
        self.size = 0
        for variable, mask in problem.free.items():
            column = np.full(mask.shape, -1, dtype=np.int64)
            count = int(mask.sum())
            column[mask] = np.arange(self.size, self.size + count)
            if count:
                self.columns[variable] = column
            self.size += count
        poses = self.columns.get(POSE, np.full((len(state[POSE]), 6), -1, dtype=np.int64))
        intrinsics = self.columns.get(INTRINSICS, np.full((1, 4), -1, dtype=np.int64))[0]
        self._pairs: list[tuple[FactorBatch, Any]] = []
        self._others: list[_OtherRows] = []
        for batch in problem.batches:
            if batch.factor_type is not depth_reprojection:
                self._others.append(self._other_rows(batch))
                continue
            try:
                system = core.PairSystem(
                    source=np.ascontiguousarray(batch.slots[0].rows, dtype=np.int64),
                    target=np.ascontiguousarray(batch.slots[1].rows, dtype=np.int64),
                    **{name: np.ascontiguousarray(array, dtype=np.float64) for name, array in batch.data.items()},
                    sigma=np.ascontiguousarray(batch.sigma),
                    weight=np.ascontiguousarray(batch.weight),
                    kernel=KERNEL_CODES[batch.kernel.kind],
                    threshold=batch.kernel.threshold,
                    pose_columns=poses,
                    intrinsics_columns=np.ascontiguousarray(intrinsics),
                    size=self.size,
                    threads=thread_count(threads),
                )
            except ValueError as error:
                batch.linearize(state)  # names the offending factor
                raise SolverError(f"{batch.name}: {error}") from error
            self._pairs.append((batch, system))

    def _other_rows(self, batch: FactorBatch) -> _OtherRows:
        columns: list[IntArray | None] = []
        for slot in batch.slots:
            column = self.columns.get(slot.variable)
            columns.append(None if column is None else np.where(column < 0, self.size, column)[slot.rows])
        return _OtherRows(batch, columns)

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        out = {batch.name: 0.0 for batch in self.problem.batches}
        for batch, system in self._pairs:
            out[batch.name] += system.energy(state[POSE], state[INTRINSICS][0])
        for other in self._others:
            out[other.batch.name] += batch_energy(other.batch, state)
        return out

    def linearize(self, state: State) -> CppPairLinearization:
        """Return the dense normal equations at ``state``.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        hessian, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        for _, system in self._pairs:
            pair_hessian, pair_gradient = system.linearize(state[POSE], state[INTRINSICS][0])
            hessian += pair_hessian
            gradient += pair_gradient
        if not np.isfinite(hessian.sum() + gradient.sum()):
            for batch, _ in self._pairs:
                batch.linearize(state)
            raise SolverError(f"{self._pairs[0][0].name}: the normal equations overflow")
        for other in self._others:
            if len(other.batch) == 0:
                continue
            r, jacobians = linearize_batch(other.batch, state)
            n, d = r.shape
            # One column more than the system has, for entries that are frozen.
            rows = np.zeros((n, d, self.size + 1))
            index = np.arange(n)[:, None]
            for columns, jacobian in zip(other.columns, jacobians, strict=True):
                if columns is not None:
                    # Slots of one factor read different rows, or the same row twice: add one slot at a time.
                    rows[index, :, columns] += np.swapaxes(jacobian, 1, 2)
            flat = rows[:, :, : self.size].reshape(n * d, self.size)
            hessian += flat.T @ flat
            gradient += flat.T @ r.reshape(-1)
        return CppPairLinearization(self, hessian, gradient)

    def retract(self, state: State, delta: FloatArray) -> State:
        """Return ``state`` moved by a step (size,) of the free entries."""
        moved = {}
        for variable, columns in self.columns.items():
            rows = np.flatnonzero((columns >= 0).any(axis=1))
            chosen = columns[rows]
            step = np.where(chosen >= 0, delta[chosen], 0.0)
            values = state[variable].copy()
            values[rows] = variable.manifold.retract(values[rows], step)
            moved[variable] = values
        return state.replace(moved)

    def parts(self) -> list[SolvedPart]:
        """Return which factors are linearized by what."""
        pairs = tuple(dict.fromkeys(batch.name for batch, _ in self._pairs))
        others = [other.batch for other in self._others]
        compiled = tuple(dict.fromkeys(b.name for b in others if has_kernel(b)))
        rest = tuple(dict.fromkeys(b.name for b in others if not has_kernel(b)))
        return [
            SolvedPart("C++ frame pairs", pairs),
            SolvedPart("C++ kernels", compiled),
            SolvedPart("linearized blocks in a dense system", rest),
        ]

    def diagnose(self, state: State) -> str:
        """Name the free variables that no factor determines, or the directions that stay free together."""
        return SchurObjective(self.problem, state, self.config, None).diagnose(state)


class CppPairLinearization:
    """The dense normal equations at one point."""

    def __init__(self, objective: CppPairObjective, hessian: FloatArray, gradient: FloatArray):
        self.hessian, self.gradient = hessian, gradient
        config = objective.config
        self._diagonal = np.clip(np.diag(hessian), config.min_diagonal, config.max_diagonal)

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient."""
        return float(np.abs(self.gradient).max(initial=0.0))

    def solve(self, damping: float) -> Step | None:
        """Return the damped step by Cholesky, or None when the system is not positive definite."""
        damped = self.hessian.copy()
        damped.reshape(-1)[:: len(damped) + 1] += damping * self._diagonal
        _, delta, info = lapack.dposv(damped, -self.gradient, lower=1)
        if info != 0 or not np.isfinite(delta).all():
            return None
        # (-g.d + damping d.D.d) / 2
        decrease = 0.5 * float(damping * np.sum(self._diagonal * delta**2) - np.sum(self.gradient * delta))
        return Step(delta, float(np.linalg.norm(delta)), decrease)
