"""The landmark Schur complement in C++ (package ``uni4d_fg_cpp``).

The same linear algebra as :mod:`uni4d_fg.optim.schur` and the same results up to rounding. Static reprojection and the
static depth prior are linearized and eliminated in C++. Every other factor takes part as linearized blocks: on
landmarks through :mod:`uni4d_fg.optim.linearized_landmarks` (C++ computes the blocks that it has a kernel for,
reprojection through a lens among them), on cameras and on variables of any other type through
:mod:`uni4d_fg.optim.camera_terms`. The reduced camera system goes to LAPACK, as a band where frames far apart share no
landmark.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import lapack

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import static_depth_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, LOG_SCALE, POSE
from uni4d_fg.optim.camera_terms import INTRINSICS_COLUMNS, CameraColumns, CameraSystem, CameraTerms
from uni4d_fg.optim.extension import KERNEL_CODES, batch_energy, import_extension
from uni4d_fg.optim.layout import DenseLayout
from uni4d_fg.optim.linearized_landmarks import LinearizedLandmarks
from uni4d_fg.optim.objective import SolvedPart, Step
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective
from uni4d_fg.optim.threads import one_blas_thread, thread_count
from uni4d_fg.optim.tiled_cholesky import cholesky


def refusal(problem: Problem, state: State | None = None) -> str:
    """Return why the C++ landmark solver does not take a problem; empty if it does.

    It takes landmarks, each free or frozen as a whole, with poses, one camera's intrinsics, one log-scale per frame,
    and variables of any other type; no factor may read two landmarks.

    Args:
        problem: The problem.
        state: Any state of it; without one, the numbers of variables that are frozen are not looked at.
    """
    if problem.eliminated is not LANDMARK or not problem.is_free(LANDMARK):
        return "no landmarks are eliminated"
    if problem.is_free_in_part(LANDMARK):
        return "some entries of a landmark are frozen and others are not"
    if state is not None and POSE not in state:
        return "the C++ landmark solver needs poses"
    if state is not None and LOG_SCALE in state and len(state[LOG_SCALE]) != len(state[POSE]):
        return "the C++ landmark solver needs one log-scale per frame"
    if problem.is_free(INTRINSICS) and len(problem.free[INTRINSICS]) != 1:
        return "the C++ landmark solver takes the intrinsics of one camera"
    for batch in problem.batches:
        if sum(s.variable is LANDMARK for s in batch.slots) > 1:
            return f"{batch.name} reads two landmarks"
    return ""


def _reads_landmark(batch: FactorBatch) -> bool:
    return any(s.variable is LANDMARK for s in batch.slots)


def _is_own(batch: FactorBatch) -> bool:
    """Return whether C++ has the factors of a batch: E_BA of the one camera, or a depth prior on its frame's scale."""
    if batch.factor_type is static_reprojection:
        return not batch.slots[2].rows.any()
    return batch.factor_type is static_depth_prior and np.array_equal(batch.slots[0].rows, batch.slots[2].rows)


class CppSchurObjective:
    """A bundle adjustment whose linear systems are solved by eliminating the landmarks, in C++."""

    def __init__(
        self,
        problem: Problem,
        state: State,
        config: SolverConfig,
        threads: int | None = None,
    ):
        """Copy and sort the factors once.

        Args:
            problem: A problem that :func:`refusal` says nothing against.
            state: Any state of the problem (only array lengths are read).
            config: Bounds of the damping diagonal.
            threads: Worker threads, on which no result depends; the number of cores when None.

        Raises:
            SolverError: If the problem is refused, or an array is.
            MissingDependencyError: If the package ``uni4d_fg_cpp`` is not installed.
        """
        core = import_extension()
        if reason := refusal(problem, state):
            raise SolverError(f"the C++ landmark solver does not take this problem: {reason}")
        self.problem, self.config = problem, config
        self.num_frames = len(state[POSE])
        self.threads = thread_count(threads)
        groups = tuple(g for g in problem.free if problem.is_free(g) and g is not LANDMARK)
        self.layout = DenseLayout.create(state, problem.free, groups)
        self.landmark_free: BoolArray = np.asarray(problem.free[LANDMARK].all(axis=1))
        self.columns = CameraColumns.create(problem, self.layout, self.num_frames, self.landmark_free)
        own = [b for b in problem.batches if _reads_landmark(b) and _is_own(b)]
        foreign = [b for b in problem.batches if len(b) and _reads_landmark(b) and not _is_own(b)]
        self._terms = CameraTerms([b for b in problem.batches if not _reads_landmark(b)], self.columns)
        self._foreign = LinearizedLandmarks(foreign, self.columns, self.landmark_free)
        reprojection = [b for b in own if b.factor_type is static_reprojection]
        depth = [b for b in own if b.factor_type is static_depth_prior]
        self._batches, self._num_reprojection = reprojection + depth, len(reprojection)
        try:
            self._system: Any = core.LandmarkSystem(
                [*(_arrays(batch, "uv") for batch in reprojection), *_storage(self._foreign)],
                [_arrays(batch, "depth") for batch in depth],
                self.num_frames,
                self.landmark_free.astype(np.int64),
                self.columns.core,
                self.layout.offset.get(INTRINSICS) is not None,
                self.columns.stored_rows,
                self.columns.banded,
                self.threads,
            )
        except ValueError as error:
            raise SolverError(f"the C++ landmark solver: {error}") from error

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        out = {batch.name: 0.0 for batch in self.problem.batches}
        energies = self._system.energies(*self._arguments(state)).tolist()
        if len(energies) > len(self._batches):
            del energies[self._num_reprojection]  # of the storage for foreign factors
        for batch, energy in zip(self._batches, energies, strict=True):
            out[batch.name] += energy
        for batch in (*self._terms.batches, *self._foreign.batches):
            out[batch.name] += batch_energy(batch, state)
        return out

    def parts(self) -> list[SolvedPart]:
        """Return which factors are linearized and eliminated by what."""
        return [
            SolvedPart("C++ landmark elimination", _names(self._batches)),
            SolvedPart("NumPy, on what is not eliminated", _names(self._terms.batches)),
            SolvedPart("linearized blocks in the C++ landmark elimination", _names(self._foreign.batches)),
        ]

    def retract(self, state: State, delta: dict[VariableType, FloatArray]) -> State:
        """Return ``state`` moved by a step per variable, landmarks then on alone if ``landmark_steps`` says so."""
        moved = state.retract(delta)
        # Of factors that C++ does not have it cannot tell where they pull a landmark.
        if not self.config.landmark_steps or self._foreign.batches:
            return moved
        landmarks = self._system.settle_landmarks(
            *self._arguments(moved), self.config.landmark_steps, self.config.min_diagonal, self.config.max_diagonal
        )
        return moved.replace({LANDMARK: landmarks})

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
        system = CameraSystem(*arrays).widened(self.columns.border)
        self._terms.add_to(system, state)
        if self._foreign.batches:
            landmark_gradient = self._foreign.add_to(self._system, system, state)
        return CppSchurLinearization(self, system, landmark_gradient)

    def diagnose(self, state: State) -> str:
        """Name the free variables that no factor determines, or the directions that stay free together."""
        return SchurObjective(self.problem, state, self.config, LANDMARK, self.threads).diagnose(state)

    def _arguments(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        scales = state[LOG_SCALE][:, 0] if LOG_SCALE in state.arrays else np.zeros(self.num_frames)
        # Without a pinhole no factor of C++'s own projects: its numbers are not read.
        intrinsics = state[INTRINSICS][0] if INTRINSICS in state.arrays else np.ones(4)
        return _dense(state[POSE]), _dense(intrinsics), _dense(scales), _dense(state[LANDMARK])


def _dense(array: Any) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64)


def _names(batches: list[FactorBatch]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(batch.name for batch in batches))


def _arrays(batch: FactorBatch, measured: str) -> tuple[Any, ...]:
    rows = {s.variable: np.ascontiguousarray(s.rows, dtype=np.int64) for s in batch.slots}
    kernel = batch.kernel
    return (
        rows[POSE], rows[LANDMARK], _dense(batch.data[measured]), _dense(batch.sigma), _dense(batch.weight),
        KERNEL_CODES[kernel.kind], kernel.threshold,
    )  # fmt: skip


def _storage(foreign: LinearizedLandmarks) -> list[tuple[Any, ...]]:
    """Return a batch of weight 0 on every pair of frame and landmark that foreign factors couple; none where none do.

    With it the system plans where their part of E stands.
    """
    frames, landmarks = foreign.pairs()
    if not len(frames):
        return []
    one = np.ones(len(frames))
    return [(frames, landmarks, np.zeros((len(frames), 2)), one, np.zeros(len(frames)), KERNEL_CODES["quadratic"], 1.0)]


class CppSchurLinearization:
    """The normal equations at one point."""

    def __init__(self, objective: CppSchurObjective, system: CameraSystem, landmark_gradient_max: float):
        self.objective, self.system = objective, system
        self._landmark_gradient_max = landmark_gradient_max
        columns = objective.columns
        self._border = np.flatnonzero(columns.layout_columns[columns.size :] >= 0)
        """Border columns that are free."""

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
        size_with_border = n + columns.border
        matrix = np.zeros((size_with_border, size_with_border))
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
        config, columns = self.objective.config, self.objective.columns
        core, system = self.objective._system, self.system.narrowed(INTRINSICS_COLUMNS)
        arrays = core.reduce(
            damping, config.min_diagonal, config.max_diagonal, system.core, system.border, system.corner,
            system.gradient,
        )  # fmt: skip
        if arrays is None:
            return None
        reduced = CameraSystem(*arrays).widened(columns.border)
        if columns.border > INTRINSICS_COLUMNS:
            rest, start = slice(INTRINSICS_COLUMNS, None), columns.size + INTRINSICS_COLUMNS
            reduced.border[:, rest] = self.system.border[:, rest]
            reduced.corner[:, rest] = self.system.corner[:, rest]
            reduced.corner[rest] = self.system.corner[rest]
            diagonal = np.clip(np.diag(self.system.corner)[rest], config.min_diagonal, config.max_diagonal)
            at = np.arange(INTRINSICS_COLUMNS, columns.border)
            reduced.corner[at, at] += damping * diagonal
            reduced.gradient[start:] = -self.system.gradient[start:]
        self.objective._foreign.correct(core, reduced)
        return reduced

    def solve(self, damping: float) -> Step | None:
        """Eliminate, solve the cameras, back-substitute the landmarks; None if not positive definite."""
        objective = self.objective
        reduced = self.reduced(damping)
        camera_step = None if reduced is None else self._solve_cameras(reduced)
        if camera_step is None:
            return None
        config, columns = objective.config, objective.columns
        landmark_step, slope, damped, squared = objective._system.back_substitute(
            np.ascontiguousarray(camera_step[: columns.size + INTRINSICS_COLUMNS]),
            objective._foreign.along(camera_step, len(objective.landmark_free)),
        )
        diagonal = np.clip(columns.diagonal(self.system), config.min_diagonal, config.max_diagonal)
        slope += float(self.system.gradient @ camera_step)
        damped += float(np.sum(diagonal * camera_step**2))
        squared += float(camera_step @ camera_step)
        if not np.isfinite([slope, damped, squared]).all():
            return None
        vector = np.zeros(objective.layout.size)
        used = columns.layout_columns >= 0
        vector[columns.layout_columns[used]] = camera_step[used]
        delta = {**objective.layout.split(vector), LANDMARK: landmark_step}
        return Step(delta, float(np.sqrt(squared)), 0.5 * (damping * damped - slope))

    def _solve_cameras(self, reduced: CameraSystem) -> FloatArray | None:
        """Solve the bordered system by Cholesky, (n + b,); overwrites the core."""
        columns, free = self.objective.columns, self._border
        n = columns.size
        step, border = np.zeros(n + columns.border), reduced.border[:, free]
        right = np.column_stack([border, reduced.gradient[:n]])
        if n:
            with one_blas_thread():
                if columns.banded:
                    factor, info = lapack.dpbtrf(reduced.core.T, lower=1, overwrite_ab=1)
                    solution = lapack.dpbtrs(factor, right, lower=1)[0] if info == 0 else None
                else:
                    factor = cholesky(reduced.core.T, self.objective.threads)
                    solution = None if factor is None else lapack.dpotrs(factor, right, lower=1)[0]
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
