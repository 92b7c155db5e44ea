"""A stage: terms, free variables, solver; and the one function that runs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from uni4d_fg.arrays import BoolArray
from uni4d_fg.config.solver import KernelConfig, SolverConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import State
from uni4d_fg.solve.backend import Backend, LinearSolver, choose_backend, make_objective, solved_by
from uni4d_fg.solve.levenberg_marquardt import Hooks, minimize
from uni4d_fg.solve.summary import SolveSummary, Termination


@dataclass(frozen=True)
class Stage:
    """A declaration of one solve."""

    name: str
    batches: tuple[FactorBatch, ...]
    free: Mapping[str, BoolArray]
    """Free entries per group (n, tangent dim); absent groups are frozen."""
    solver: SolverConfig
    linear_solver: LinearSolver = "schur"
    eliminate: str | None = None
    """Group eliminated before the dense solve ('schur')."""
    annealing: tuple[float, ...] = (1.0,)
    """Successive solves with every 'norm' kernel's smoothing multiplied by these factors, ending at 1."""

    @property
    def problem(self) -> Problem:
        """The least-squares problem of the last (unsmoothed) solve."""
        return Problem(self.batches, self.free)

    @property
    def reads_free_variables(self) -> bool:
        """Whether any factor reads a variable that may move."""
        problem = self.problem
        return any(len(batch) and any(problem.is_free(s.group) for s in batch.slots) for batch in self.batches)


StageRunner: TypeAlias = Callable[[Stage, State, Hooks | None], tuple[State, SolveSummary]]
"""``run(stage, state, hooks)``: what solves a stage; :func:`run_stage`, or another minimiser of the same energy."""


def run_stage(
    stage: Stage, state: State, hooks: Hooks | None = None, backend: Backend | None = None
) -> tuple[State, SolveSummary]:
    """Solve a stage from ``state``; the summary's energies are those of the final kernels.

    Args:
        stage: What to solve.
        state: Starting point.
        hooks: Progress and cancellation.
        backend: Implementation; the fastest that is installed when None.

    Raises:
        SolverError: See :func:`uni4d_fg.solve.levenberg_marquardt.minimize`.
    """
    backend = backend or choose_backend("auto")
    problem = stage.problem
    if not stage.reads_free_variables:
        initial = problem.energies(state)
        return state, SolveSummary(stage.name, Termination.NOTHING_TO_DO, initial, initial, (), {"total": 0.0})
    # A round without smoothing measures the stage's own energy; GTSAM measures it behind the camera otherwise.
    exact = [factor == 1.0 and backend.name != "gtsam" for factor in stage.annealing]
    initial = {} if exact[0] else problem.energies(state)
    parts: list[SolveSummary] = []
    solvers: list[str] = []
    for factor in stage.annealing:
        solver = _round_solver(stage, factor)
        objective = make_objective(
            backend,
            Problem(_smoothed(stage.batches, factor), stage.free),
            state,
            solver,
            eliminate=stage.eliminate,
            linear_solver=stage.linear_solver,
        )
        state, summary = minimize(objective, state, solver, name=stage.name, hooks=hooks)
        parts.append(summary)
        solvers.append(solved_by(objective))
        if summary.termination is Termination.CANCELLED:
            break
    initial = parts[0].initial_energies if exact[0] else initial
    final = parts[-1].final_energies if exact[len(parts) - 1] else problem.energies(state)
    notes = {"backend": backend.name, "solved_by": solvers[-1]}
    return state, _join(stage, problem, (initial, final), parts, notes)


@dataclass(frozen=True)
class LevenbergMarquardtRunner:
    """Solves stages by Levenberg-Marquardt with one backend; a ``StageRunner``."""

    backend: Backend

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage; see :func:`run_stage`."""
        return run_stage(stage, state, hooks, self.backend)


def _round_solver(stage: Stage, factor: float) -> SolverConfig:
    """Return the solver's options for one round of annealing."""
    looser = stage.solver.smoothed_relative_decrease
    if looser is None or factor == stage.annealing[-1]:
        return stage.solver
    return stage.solver.model_copy(update={"relative_decrease": looser})


def _smoothed(batches: tuple[FactorBatch, ...], factor: float) -> tuple[FactorBatch, ...]:
    def smooth(batch: FactorBatch) -> FactorBatch:
        if batch.kernel.kind != "norm" or factor == 1.0:
            return batch
        return replace(batch, kernel=Kernel("norm", batch.kernel.threshold * factor))

    return tuple(smooth(batch) for batch in batches)


def _join(
    stage: Stage,
    problem: Problem,
    energies: tuple[dict[str, float], dict[str, float]],
    parts: list[SolveSummary],
    notes: dict[str, Any],
) -> SolveSummary:
    seconds: dict[str, float] = {}
    iterations = []
    for part in parts:
        offset = seconds.get("total", 0.0)
        iterations += [replace(record, seconds=record.seconds + offset) for record in part.iterations]
        for phase, value in part.seconds.items():
            seconds[phase] = seconds.get(phase, 0.0) + value
    if len(parts) > 1:
        notes = {**notes, "rounds": len(parts)}
    return SolveSummary(
        stage.name,
        parts[-1].termination,
        *energies,
        tuple(iterations),
        seconds,
        num_factors=sum(len(batch) for batch in stage.batches),
        num_variables=sum(int(rows.sum()) for rows in problem.free_rows().values()),
        notes=notes,
    )


def kernel_of(config: KernelConfig) -> Kernel:
    """Return the kernel a config section describes."""
    return Kernel(config.kind, config.threshold)
