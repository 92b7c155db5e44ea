"""A stage: terms, free variables, solver; and the one function that runs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from uni4d_fg.arrays import BoolArray
from uni4d_fg.config.solver import KernelConfig, SolverConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import State
from uni4d_fg.solve.levenberg_marquardt import Hooks, minimize
from uni4d_fg.solve.objective import Objective
from uni4d_fg.solve.schur import SchurObjective
from uni4d_fg.solve.summary import SolveSummary, Termination
from uni4d_fg.solve.trajectory_cg import TrajectoryObjective


@dataclass(frozen=True)
class Stage:
    """A declaration of one solve."""

    name: str
    batches: tuple[FactorBatch, ...]
    free: Mapping[str, BoolArray]
    """Free entries per group (n, tangent dim); absent groups are frozen."""
    solver: SolverConfig
    linear_solver: Literal["schur", "trajectory_cg"] = "schur"
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


def run_stage(stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
    """Solve a stage from ``state``; the summary's energies are those of the final kernels.

    Raises:
        SolverError: See :func:`uni4d_fg.solve.levenberg_marquardt.minimize`.
    """
    problem = stage.problem
    initial = problem.energies(state)
    if not stage.reads_free_variables:
        return state, SolveSummary(stage.name, Termination.NOTHING_TO_DO, initial, initial, (), {"total": 0.0})
    parts: list[SolveSummary] = []
    for factor in stage.annealing:
        objective = _objective(stage, Problem(_smoothed(stage.batches, factor), stage.free), state)
        state, summary = minimize(objective, state, stage.solver, name=stage.name, hooks=hooks)
        parts.append(summary)
        if summary.termination is Termination.CANCELLED:
            break
    return state, _join(stage, problem, initial, state, parts)


def _objective(stage: Stage, problem: Problem, state: State) -> Objective[State]:
    if stage.linear_solver == "trajectory_cg":
        return TrajectoryObjective(problem, state, stage.solver)
    return SchurObjective(problem, state, stage.solver, stage.eliminate)


def _smoothed(batches: tuple[FactorBatch, ...], factor: float) -> tuple[FactorBatch, ...]:
    def smooth(batch: FactorBatch) -> FactorBatch:
        if batch.kernel.kind != "norm" or factor == 1.0:
            return batch
        return replace(batch, kernel=Kernel("norm", batch.kernel.threshold * factor))

    return tuple(smooth(batch) for batch in batches)


def _join(
    stage: Stage, problem: Problem, initial: dict[str, float], state: State, parts: list[SolveSummary]
) -> SolveSummary:
    seconds: dict[str, float] = {}
    iterations = []
    for part in parts:
        offset = seconds.get("total", 0.0)
        iterations += [replace(record, seconds=record.seconds + offset) for record in part.iterations]
        for phase, value in part.seconds.items():
            seconds[phase] = seconds.get(phase, 0.0) + value
    notes: dict[str, Any] = {"rounds": len(parts)} if len(parts) > 1 else {}
    return SolveSummary(
        stage.name,
        parts[-1].termination,
        initial,
        problem.energies(state),
        tuple(iterations),
        seconds,
        num_factors=sum(len(batch) for batch in stage.batches),
        num_variables=sum(int(rows.sum()) for rows in problem.free_rows().values()),
        notes=notes,
    )


def kernel_of(config: KernelConfig) -> Kernel:
    """Return the kernel a config section describes."""
    return Kernel(config.kind, config.threshold)
