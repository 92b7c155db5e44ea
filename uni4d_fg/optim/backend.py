"""Which implementation solves a stage: C++, NumPy or GTSAM."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.optim.block import MOST_DENSE_COLUMNS, BlockObjective
from uni4d_fg.optim.extension import INSTALL_COMMAND, find_extension, import_extension
from uni4d_fg.optim.objective import Objective, SolvedPart
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective
from uni4d_fg.optim.trajectory_cg import TrajectoryObjective

BackendChoice = Literal["auto", "cpp", "python", "gtsam"]
"""What a configuration may ask for."""


@dataclass(frozen=True)
class Backend:
    """A choice that was made."""

    name: Literal["cpp", "python", "gtsam"]
    hint: str = ""
    """One line on a faster path that is not installed; empty when there is none."""


def choose_backend(choice: BackendChoice) -> Backend:
    """Settle what to use.

    Args:
        choice: 'auto' takes the C++ extension where it is installed, NumPy where it is not.

    Raises:
        MissingDependencyError: If 'cpp' is asked for and the extension cannot be used; says how to install it.
    """
    if choice == "auto":
        core, reason = find_extension()
        if core is not None:
            return Backend("cpp")
        return Backend("python", f"{reason}; a faster path exists: run `{INSTALL_COMMAND}`")
    if choice == "cpp":
        import_extension()
    return Backend(choice)


@dataclass(frozen=True)
class Planned:
    """An objective, and why nothing faster was chosen."""

    objective: Objective[State]
    why: str = ""

    def parts(self) -> list[SolvedPart]:
        """Return what solves which terms, and why not something faster."""
        found = [part for part in self.objective.parts() if part.terms]
        return [replace(part, why=self.why) for part in found] if self.why else found


def make_objective(backend: Backend, problem: Problem, state: State, config: SolverConfig) -> Planned:
    """Return what the Levenberg-Marquardt driver minimizes: the fastest solver that claims the problem's structure.

    Args:
        backend: Implementation.
        problem: Factors and free entries.
        state: Starting point.
        config: Damping bounds and inner tolerances.
    """
    from uni4d_fg.optim import cpp_pairs, cpp_schur, cpp_trajectory

    if backend.name == "gtsam":
        from uni4d_fg.optim.gtsam_objective import GtsamObjective

        return Planned(GtsamObjective(problem, state, config))
    compiled, why = backend.name == "cpp", ""
    if is_trajectories(problem):
        why = cpp_trajectory.refusal(problem) if compiled else ""
        if compiled and not why:
            return Planned(cpp_trajectory.CppTrajectoryObjective(problem, state, config))
        return Planned(TrajectoryObjective(problem, state, config), why)
    if compiled:
        if not (why := cpp_pairs.refusal(problem)):
            return Planned(cpp_pairs.CppPairObjective(problem, state, config))
        if problem.eliminated is not None and not (why := cpp_schur.refusal(problem, state) or _too_many(problem)):
            return Planned(cpp_schur.CppSchurObjective(problem, state, config))
    if reason := block_reason(problem):
        return Planned(BlockObjective(problem, state, config), reason)
    return Planned(SchurObjective(problem, state, config, problem.eliminated), why)


def is_trajectories(problem: Problem) -> bool:
    """Return whether moving points are all that is free, every one of them is, and nothing else is read."""
    free = [variable for variable in problem.free if problem.is_free(variable)]
    if free != [DYNAMIC_POINT] or not problem.free[DYNAMIC_POINT].all():
        return False
    return all(s.variable is DYNAMIC_POINT for batch in problem.batches for s in batch.slots)


def block_reason(problem: Problem) -> str:
    """Return why a problem needs the generic sparse solver; empty if a dense system with eliminated points will do."""
    points = problem.eliminated
    if points is not None and any(sum(s.variable is points for s in b.slots) > 1 for b in problem.batches):
        return f"a factor reads two {points} variables"
    if points is not None and problem.is_free_in_part(points):
        return f"some entries of a {points} variable are frozen and others are not"
    return _too_many(problem)


def _too_many(problem: Problem) -> str:
    """Return why a dense system of what is not eliminated would be too large; empty if it would not."""
    columns = sum(int(mask.sum()) for variable, mask in problem.free.items() if variable is not problem.eliminated)
    return f"{columns} entries are free beside the eliminated points" if columns > MOST_DENSE_COLUMNS else ""
