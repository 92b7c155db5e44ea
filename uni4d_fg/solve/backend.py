"""Which implementation solves a stage: C++, NumPy or GTSAM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import State
from uni4d_fg.solve.extension import INSTALL_COMMAND, find_extension, import_extension
from uni4d_fg.solve.objective import Objective
from uni4d_fg.solve.schur import SchurObjective
from uni4d_fg.solve.trajectory_cg import TrajectoryObjective

BackendChoice = Literal["auto", "cpp", "python", "gtsam"]
"""What a configuration may ask for."""

LinearSolver = Literal["schur", "trajectory_cg"]


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


def make_objective(
    backend: Backend,
    problem: Problem,
    state: State,
    config: SolverConfig,
    *,
    eliminate: str | None,
    linear_solver: LinearSolver,
) -> Objective[State]:
    """Return what the Levenberg-Marquardt driver minimises.

    Args:
        backend: Implementation; a problem that the C++ systems do not take is solved by NumPy.
        problem: Factors and free entries.
        state: Starting point.
        config: Damping bounds and inner tolerances.
        eliminate: Group eliminated before the dense solve ('schur').
        linear_solver: How the stage asks for its systems to be solved; GTSAM eliminates whatever is asked.
    """
    if backend.name == "gtsam":
        from uni4d_fg.solve.gtsam_objective import GtsamObjective

        return GtsamObjective(problem, state)
    compiled = None
    if backend.name == "cpp":
        compiled = _compiled_objective(problem, state, config, eliminate, linear_solver)
    if compiled is not None:
        return compiled
    if linear_solver == "trajectory_cg":
        return TrajectoryObjective(problem, state, config)
    return SchurObjective(problem, state, config, eliminate)


def _compiled_objective(
    problem: Problem, state: State, config: SolverConfig, eliminate: str | None, linear_solver: LinearSolver
) -> Objective[State] | None:
    from uni4d_fg.solve import cpp_pairs, cpp_schur, cpp_trajectory

    if linear_solver == "trajectory_cg":
        return (
            cpp_trajectory.CppTrajectoryObjective(problem, state, config) if cpp_trajectory.supports(problem) else None
        )
    if cpp_pairs.supports(problem, eliminate):
        return cpp_pairs.CppPairObjective(problem, state, config)
    if eliminate is not None and cpp_schur.supports(problem, eliminate):
        return cpp_schur.CppSchurObjective(problem, state, config, eliminate)
    return None


def solved_by(objective: Objective[State]) -> str:
    """Return the name of the implementation of an objective, for summaries."""
    name = type(objective).__name__
    known = {
        "CppPairObjective": "C++ frame pairs",
        "CppSchurObjective": "C++ landmark elimination",
        "CppTrajectoryObjective": "C++ trajectories",
        "GtsamObjective": "GTSAM",
        "SchurObjective": "NumPy landmark elimination",
        "TrajectoryObjective": "NumPy trajectories",
    }
    if name not in known:
        raise SolverError(f"unknown objective {name}")
    return known[name]
