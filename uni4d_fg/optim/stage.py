"""A stage: terms, free variables, solver; and the one function that runs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeAlias

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.optim.backend import Backend, Planned, choose_backend, make_objective
from uni4d_fg.optim.levenberg_marquardt import Hooks, minimize
from uni4d_fg.optim.objective import Reweightable, SolvedPart
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.summary import IterationRecord, SolveSummary, Termination

_CONVERGED = 1e-7
"""Relative decrease of the energy at which a refinement ends that tells a focal length: far in a valley, a step that
lowers the energy by 1e-5 may still move it by several percent."""
_PATIENCE = 10
"""So many times more steps such a refinement may take: through a long lens that pans and moves, more than twice as many
as others may."""


@dataclass(frozen=True)
class Round:
    """One of several successive solves of a stage: an easier energy that leads to the stage's own."""

    smoothing: float = 1.0
    """Factor on the smoothing of every 'norm' kernel."""
    weight: Mapping[str, float] = field(default_factory=dict)
    """Factor on the weights of terms, by name."""

    @property
    def is_exact(self) -> bool:
        """Whether it solves the stage's own energy."""
        return self.smoothing == 1.0 and all(factor == 1.0 for factor in self.weight.values())

    def apply(self, batch: FactorBatch) -> FactorBatch:
        """Return a batch as this round sees it."""
        factor = self.weight.get(batch.name, 1.0)
        if factor != 1.0:
            batch = replace(batch, weight=factor * batch.weight)
        if batch.kernel.kind == "norm" and self.smoothing != 1.0:
            batch = replace(batch, kernel=Kernel("norm", self.smoothing * batch.kernel.threshold))
        return batch


@dataclass(frozen=True)
class Stage:
    """A declaration of one solve: a problem, and how it is minimized."""

    kind: str
    """What is solved: camera_init, bundle_adjustment, structure, pose, nonrigid, ..."""
    problem: Problem
    """Of the last round of every schedule."""
    solver: SolverConfig
    part: str = ""
    """Which of several solves of a kind, such as the frames of a window."""
    schedules: tuple[tuple[Round, ...], ...] = ((Round(),),)
    """Ways to go: successive solves each, of which the last is exact. All start alike; the lowest end is kept."""
    own_world: bool = False
    """Its world begins at a camera of its own, not at the video's first, and meters there may be others."""
    bounds: frozenset[str] = frozenset()
    """Names of terms that keep a solver which goes to the minimum near the start, and are no part of the energy."""
    unbounded_solver: SolverConfig | None = None
    """Solver options of the stage without its bounds, where they are others."""

    def unbounded(self) -> Stage:
        """Return the stage without its bounds: what a descent that stops early solves, and what is compared."""
        if not self.bounds:
            return self
        kept = tuple(batch for batch in self.problem.batches if batch.name not in self.bounds)
        solver = self.unbounded_solver or self.solver
        return replace(self, problem=replace(self.problem, batches=kept), bounds=frozenset(), solver=solver)

    @property
    def name(self) -> str:
        """Kind and part, for summaries and messages."""
        return f"{self.kind}[{self.part}]" if self.part else self.kind

    @property
    def finds_cameras(self) -> bool:
        """Whether it is bundle adjustment, alone or in the joint energy: where measurements of the cameras join."""
        return self.kind in ("bundle_adjustment", "joint")

    @property
    def reads_free_variables(self) -> bool:
        """Whether any factor reads a variable that may move."""
        problem = self.problem
        return any(len(batch) and any(problem.is_free(s.variable) for s in batch.slots) for batch in problem.batches)


StageRunner: TypeAlias = Callable[[Stage, State, Hooks | None], tuple[State, SolveSummary]]
"""``run(stage, state, hooks)``: what solves a stage; :func:`run_stage`, or another minimizer of the same energy."""


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
        SolverError: See :func:`uni4d_fg.optim.levenberg_marquardt.minimize`.
    """
    backend = backend or choose_backend("auto")
    problem = stage.problem
    if not stage.reads_free_variables:
        initial = problem.energies(state)
        return state, SolveSummary(stage.name, Termination.NOTHING_TO_DO, initial, initial, (), {"total": 0.0})
    ends: list[tuple[State, SolveSummary]] = []
    rounds = _Rounds(stage, backend)
    for schedule in stage.schedules:
        ends.append(_run_schedule(rounds, schedule, state, hooks))
        if ends[-1][1].termination is Termination.CANCELLED:
            break
    kept, summary = min(ends, key=lambda end: end[1].final_energy)
    return kept, _join_schedules(summary, [summary for _, summary in ends])


class _Rounds:
    """Makes the objectives of the rounds of a stage; one that can be reweighted is planned once."""

    def __init__(self, stage: Stage, backend: Backend):
        self.stage, self.backend = stage, backend
        self._planned: Planned | None = None

    def solve(
        self, step: Round, state: State, solver: SolverConfig, hooks: Hooks | None
    ) -> tuple[State, SolveSummary, list[SolvedPart]]:
        """Solve a round; also return what solved which terms."""
        full, name = self.stage.problem, self.stage.name
        problem = replace(full, batches=tuple(step.apply(batch) for batch in full.batches))
        if solver.optimizer != "levenberg_marquardt":
            from uni4d_fg.optim.gtsam_optimizers import gtsam_parts, minimize_with_gtsam

            return *minimize_with_gtsam(problem, state, solver, name=name, hooks=hooks), gtsam_parts(problem, solver)
        planned = self._plan(problem, state, solver)
        return *minimize(planned.objective, state, solver, name=name, hooks=hooks), planned.parts()

    def _plan(self, problem: Problem, state: State, solver: SolverConfig) -> Planned:
        """Return what a round minimizes."""
        if self._planned is not None and isinstance(self._planned.objective, Reweightable):
            self._planned.objective.reweight(problem)
        else:
            self._planned = make_objective(self.backend, problem, state, solver)
        return self._planned


def _run_schedule(
    rounds: _Rounds, schedule: tuple[Round, ...], state: State, hooks: Hooks | None
) -> tuple[State, SolveSummary]:
    stage, backend = rounds.stage, rounds.backend
    problem = stage.problem
    exact = [step.is_exact for step in schedule]
    initial = {} if exact[0] else problem.energies(state)
    parts: list[SolveSummary] = []
    solved_by: list[dict[str, Any]] = []
    for step in schedule:
        solver = stage.solver if step is schedule[-1] else early(stage.solver)
        state, summary, by = rounds.solve(step, state, solver, hooks)
        parts.append(summary)
        solved_by = [asdict(part) for part in by]
        if summary.termination is Termination.CANCELLED:
            break
    initial = parts[0].initial_energies if exact[0] else initial
    final = parts[-1].final_energies if exact[len(parts) - 1] else problem.energies(state)
    notes: dict[str, Any] = {"backend": backend.name, "solved_by": solved_by}
    for part in parts:
        notes |= part.notes
    if len(parts) > 1:
        notes["rounds"] = len(parts)
    iterations, seconds = _succession(parts)
    return state, SolveSummary(
        stage.name,
        parts[-1].termination,
        initial,
        final,
        iterations,
        seconds,
        num_factors=sum(len(batch) for batch in problem.batches),
        num_variables=sum(int(rows.sum()) for rows in problem.free_rows().values()),
        notes=notes,
    )


@dataclass(frozen=True)
class LevenbergMarquardtRunner:
    """Solves stages by Levenberg-Marquardt with one backend; a ``StageRunner``."""

    backend: Backend

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage; see :func:`run_stage`."""
        return run_stage(stage, state, hooks, self.backend)


def early(solver: SolverConfig) -> SolverConfig:
    """Return the solver's options for what only leads to the solve that counts: all rounds but the last."""
    looser = solver.early_relative_decrease
    return solver if looser is None else solver.model_copy(update={"relative_decrease": looser})


def until_converged(stage: Stage) -> Stage:
    """Return a stage that ends only where the focal length, or what follows one that is held, stays where it is."""
    longer = {"relative_decrease": _CONVERGED, "max_iterations": _PATIENCE * stage.solver.max_iterations}
    return replace(stage, solver=stage.solver.model_copy(update=longer))


def _join_schedules(kept: SolveSummary, all_of_them: list[SolveSummary]) -> SolveSummary:
    """Return the summary of the schedule that is kept, with the work of all."""
    if len(all_of_them) == 1:
        return kept
    iterations, seconds = _succession(all_of_them)
    ends = [summary.final_energy for summary in all_of_them]
    cancelled = all_of_them[-1].termination is Termination.CANCELLED
    return replace(
        kept,
        termination=Termination.CANCELLED if cancelled else kept.termination,
        iterations=iterations,
        seconds=seconds,
        notes={**kept.notes, "schedule_energies": ends},
    )


def _succession(parts: list[SolveSummary]) -> tuple[tuple[IterationRecord, ...], dict[str, float]]:
    """Return the iterations of solves that followed each other, on one clock, and the sum of their times."""
    seconds: dict[str, float] = {}
    iterations = []
    for part in parts:
        offset = seconds.get("total", 0.0)
        iterations += [replace(record, seconds=record.seconds + offset) for record in part.iterations]
        for phase, value in part.seconds.items():
            seconds[phase] = seconds.get(phase, 0.0) + value
    return tuple(iterations), seconds
