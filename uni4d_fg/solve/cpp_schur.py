"""The landmark Schur complement in C++ (package ``uni4d_fg_cpp``).

The same linear algebra as :mod:`uni4d_fg.solve.schur` and the same results up to rounding. Factors that read a
landmark are linearised and eliminated in C++; the few that read cameras alone are added by NumPy; the reduced
camera system goes to LAPACK, as a band where frames far apart share no landmark.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import lapack

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import STATIC_DEPTH_PRIOR
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import State
from uni4d_fg.solve.camera_terms import BORDER, CameraColumns, CameraSystem, CameraTerms
from uni4d_fg.solve.extension import KERNEL_CODES
from uni4d_fg.solve.layout import DenseLayout
from uni4d_fg.solve.objective import Step
from uni4d_fg.solve.schur import SchurObjective
from uni4d_fg.solve.threads import limit_blas_threads, thread_count

_CAMERA_GROUPS = {"pose", "log_scale", "intrinsics"}
_THREADED_SIZE = 600
"""Dense systems from this size on are factorised by all threads; below, a second one costs more than it gains."""


def supports(problem: Problem, eliminate: str | None = "landmark") -> bool:
    """Return whether the C++ solver takes a problem: bundle adjustment with free landmarks and one camera.

    Every batch that reads a landmark must be a static reprojection on intrinsics row 0 or a static depth prior
    whose log-scale is that of its pose's frame; only poses, intrinsics, log-scales and landmarks may be free.
    """
    if eliminate != "landmark" or not problem.is_free("landmark"):
        return False
    if any(problem.is_free(group) for group in problem.free if group not in {*_CAMERA_GROUPS, "landmark"}):
        return False
    if problem.is_free("intrinsics") and len(problem.free["intrinsics"]) != 1:
        return False
    return all(_is_supported(batch) for batch in problem.batches if _reads_landmark(batch))


def _reads_landmark(batch: FactorBatch) -> bool:
    return any(s.group == "landmark" for s in batch.slots)


def _is_supported(batch: FactorBatch) -> bool:
    if batch.family == STATIC_REPROJECTION:
        return not batch.slots[2].rows.any()
    return batch.family == STATIC_DEPTH_PRIOR and np.array_equal(batch.slots[0].rows, batch.slots[2].rows)


class CppSchurObjective:
    """A bundle adjustment whose linear systems are solved by eliminating the landmarks, in C++."""

    def __init__(
        self,
        problem: Problem,
        state: State,
        config: SolverConfig,
        eliminate: str = "landmark",
        threads: int | None = None,
    ):
        """Copy and sort the factors once.

        Args:
            problem: A problem that :func:`supports` accepts.
            state: Any state of the problem (only array lengths are read).
            config: Bounds of the damping diagonal.
            eliminate: 'landmark'.
            threads: Worker threads; the number of cores when None.

        Raises:
            SolverError: If the problem is not supported, or an array is refused.
            ModuleNotFoundError: If the package ``uni4d_fg_cpp`` is not installed.
        """
        from uni4d_fg_cpp import _core

        if not supports(problem, eliminate):
            raise SolverError("the C++ landmark solver does not take this problem")
        self.problem, self.config = problem, config
        self.num_frames = len(state["pose"])
        self.threads = thread_count(threads)
        groups = tuple(g for g in problem.free if problem.is_free(g) and g != eliminate)
        self.layout = DenseLayout.create(state, problem.free, groups)
        self.landmark_free: BoolArray = np.asarray(problem.free["landmark"].all(axis=1))
        if self.layout.count.get("log_scale", self.num_frames) != self.num_frames:
            raise SolverError("the C++ landmark solver needs one log-scale per frame")
        self.columns = CameraColumns.create(problem, self.layout, self.num_frames, self.landmark_free)
        self._terms = CameraTerms([b for b in problem.batches if not _reads_landmark(b)], self.columns)
        reprojection = [b for b in problem.batches if b.family == STATIC_REPROJECTION]
        depth = [b for b in problem.batches if b.family == STATIC_DEPTH_PRIOR]
        self._batches = reprojection + depth
        try:
            self._system: Any = _core.LandmarkSystem(
                [_arrays(batch, "uv") for batch in reprojection],
                [_arrays(batch, "depth") for batch in depth],
                self.num_frames,
                self.landmark_free.astype(np.int64),
                self.columns.core,
                self.layout.offset.get("intrinsics") is not None,
                self.columns.stored_rows,
                self.columns.banded,
                self.threads,
            )
        except ValueError as error:
            raise SolverError(f"the C++ landmark solver: {error}") from error

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        out = {batch.name: 0.0 for batch in self.problem.batches}
        for batch, energy in zip(self._batches, self._system.energies(*self._arguments(state)).tolist(), strict=True):
            out[batch.name] += energy
        for batch in self._terms.batches:
            out[batch.name] += batch.energy(state)
        return out

    def retract(self, state: State, delta: dict[str, FloatArray]) -> State:
        """Return ``state`` moved by a step per group."""
        return state.retract(delta)

    def linearize(self, state: State) -> CppSchurLinearization:
        """Accumulate the normal equations at ``state``; they are valid until the next call.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        *arrays, landmark_gradient, finite = self._system.linearize(*self._arguments(state))
        if not finite:
            with np.errstate(all="ignore"):
                for batch in self._batches:
                    batch.linearize(state)  # names the offending factor
        system = CameraSystem(*arrays)
        self._terms.add_to(system, state)
        return CppSchurLinearization(self, system, landmark_gradient)

    def diagnose(self, state: State) -> str:
        """Name the free variables that no factor determines, or the directions that stay free together."""
        return SchurObjective(self.problem, state, self.config, "landmark", self.threads).diagnose(state)

    def _arguments(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        scales = state["log_scale"][:, 0] if "log_scale" in state.groups else np.zeros(self.num_frames)
        return _dense(state["pose"]), _dense(state["intrinsics"][0]), _dense(scales), _dense(state["landmark"])


def _dense(array: Any) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64)


def _arrays(batch: FactorBatch, measured: str) -> tuple[Any, ...]:
    rows = {s.group: np.ascontiguousarray(s.rows, dtype=np.int64) for s in batch.slots}
    kernel = batch.kernel
    return (
        rows["pose"], rows["landmark"], _dense(batch.data[measured]), _dense(batch.sigma), _dense(batch.weight),
        KERNEL_CODES[kernel.kind], kernel.threshold,
    )  # fmt: skip


class CppSchurLinearization:
    """The normal equations at one point."""

    def __init__(self, objective: CppSchurObjective, system: CameraSystem, landmark_gradient_max: float):
        self.objective, self.system = objective, system
        self._landmark_gradient_max = landmark_gradient_max
        columns = objective.columns
        self._border = np.flatnonzero(columns.layout_columns[columns.size :] >= 0)
        """Free intrinsics."""

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient over the free entries."""
        size = self.objective.columns.size
        parts = (self.system.gradient[:size], self.system.gradient[size + self._border])
        return max(self._landmark_gradient_max, *(float(np.abs(part).max(initial=0.0)) for part in parts))

    def landmark_blocks(self) -> tuple[FloatArray, FloatArray]:
        """Return the landmarks' own blocks of the Hessian (N, 3, 3) and gradients (N, 3); 0 for frozen ones."""
        blocks, gradients = self.objective._system.landmark_blocks()
        return blocks, gradients

    def dense(self, system: CameraSystem) -> tuple[FloatArray, FloatArray]:
        """Spread a camera system over the columns of the dense layout, (size, size) and (size,); frozen ones are 0."""
        columns, size = self.objective.columns, self.objective.layout.size
        n = columns.size
        matrix = np.zeros((n + BORDER, n + BORDER))
        for j in range(n):
            stop = min(j + columns.stored_rows, n)
            matrix[j:stop, j] = system.core[j, : stop - j] if columns.banded else system.core[j, j:]
        matrix[:n, :n] += np.tril(matrix[:n, :n], -1).T
        matrix[:n, n:], matrix[n:, :n], matrix[n:, n:] = system.border, system.border.T, system.corner
        used = np.flatnonzero(columns.layout_columns >= 0)
        at = columns.layout_columns[used]
        out, vector = np.zeros((size, size)), np.zeros(size)
        out[np.ix_(at, at)], vector[at] = matrix[np.ix_(used, used)], system.gradient[used]
        return out, vector

    def reduced(self, damping: float) -> CameraSystem | None:
        """Eliminate the landmarks; None when a landmark's block is not positive definite."""
        config, system = self.objective.config, self.system
        arrays = self.objective._system.reduce(
            damping, config.min_diagonal, config.max_diagonal, system.core, system.border, system.corner,
            system.gradient,
        )  # fmt: skip
        return None if arrays is None else CameraSystem(*arrays)

    def solve(self, damping: float) -> Step | None:
        """Eliminate, solve the cameras, back-substitute the landmarks; None if not positive definite."""
        objective = self.objective
        reduced = self.reduced(damping)
        camera_step = None if reduced is None else self._solve_cameras(reduced)
        if camera_step is None:
            return None
        landmark_step, slope, damped, squared = objective._system.back_substitute(camera_step)
        config, columns = objective.config, objective.columns
        diagonal = np.clip(columns.diagonal(self.system), config.min_diagonal, config.max_diagonal)
        slope += float(self.system.gradient @ camera_step)
        damped += float(np.sum(diagonal * camera_step**2))
        squared += float(camera_step @ camera_step)
        if not np.isfinite([slope, damped, squared]).all():
            return None
        vector = np.zeros(objective.layout.size)
        used = columns.layout_columns >= 0
        vector[columns.layout_columns[used]] = camera_step[used]
        delta = {**objective.layout.split(vector), "landmark": landmark_step}
        return Step(delta, float(np.sqrt(squared)), 0.5 * (damping * damped - slope))

    def _solve_cameras(self, reduced: CameraSystem) -> FloatArray | None:
        """Solve the bordered system by Cholesky, (n + 4,); overwrites the core."""
        columns, free = self.objective.columns, self._border
        n = columns.size
        step, border = np.zeros(n + BORDER), reduced.border[:, free]
        right = np.column_stack([border, reduced.gradient[:n]])
        if n:
            threads = self.objective.threads if n >= _THREADED_SIZE and not columns.banded else 1
            with limit_blas_threads(threads):
                if columns.banded:
                    factor, info = lapack.dpbtrf(reduced.core.T, lower=1, overwrite_ab=1)
                    solution = lapack.dpbtrs(factor, right, lower=1)[0] if info == 0 else None
                else:
                    factor, info = lapack.dpotrf(reduced.core.T, lower=1, overwrite_a=1, clean=0)
                    solution = lapack.dpotrs(factor, right, lower=1)[0] if info == 0 else None
            if solution is None:
                return None
            right = solution
        if len(free):
            corner = reduced.corner[np.ix_(free, free)] - border.T @ right[:, :-1]
            rest = reduced.gradient[n + free] - border.T @ right[:, -1]
            try:
                factor = np.linalg.cholesky(corner)
            except np.linalg.LinAlgError:
                return None
            step[n + free] = np.linalg.solve(factor.T, np.linalg.solve(factor, rest))
        step[:n] = right[:, -1] - right[:, :-1] @ step[n + free]
        return step
