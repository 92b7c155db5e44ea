"""Solving a problem of one's own, and the covariance of what was found."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.backend import BackendChoice, choose_backend
from uni4d_fg.optim.block import BlockObjective
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem, check_rows
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.optim.summary import SolveSummary


def solve(
    problem: Problem,
    state: State,
    config: SolverConfig | None = None,
    backend: BackendChoice = "auto",
    hooks: Hooks | None = None,
) -> tuple[State, SolveSummary]:
    """Minimize a problem from ``state`` by Levenberg-Marquardt, with the fastest solver that takes it.

    Args:
        problem: Factors, free entries, points to eliminate.
        state: Starting values; not modified.
        config: Tolerances and limits.
        backend: 'auto', 'cpp', 'python' or 'gtsam'.
        hooks: Progress and cancellation.

    Returns:
        The best state found, and a summary: why it ended, energies per term, what solved which terms.

    Raises:
        SolverError: If a factor is not finite or reads a variable that the state does not have, or the system is
            singular; names the variables.
        MissingDependencyError: If 'cpp' is asked for and not installed.
    """
    check_rows(problem.batches, state)
    return run_stage(Stage("problem", problem, config or SolverConfig()), state, hooks, choose_backend(backend))


def marginals(problem: Problem, state: State, variable: VariableType, rows: list[int] | None = None) -> FloatArray:
    """Return the marginal covariances of variables of any type at a solution.

    The inverse of J^T J over all free entries, others marginalized out; robust kernels count by their weights.

    Args:
        problem: Factors and free entries.
        state: The solution.
        variable: Type of the variables.
        rows: Which of them; all when None.

    Returns:
        (n, d, d) in the variables' tangents; zero rows and columns for frozen entries.

    Raises:
        SolverError: If the factors do not determine every free entry, or a factor is not finite or reads a variable
            that the state does not have.
    """
    check_rows(problem.batches, state)
    objective = BlockObjective(problem, state, SolverConfig())
    linearization = objective.linearize(state)
    hessian = (linearization.matrix.T @ linearization.matrix).toarray()
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    try:
        factor = scipy.linalg.cho_factor(hessian / scale[:, None] / scale, lower=True)
    except np.linalg.LinAlgError:
        raise SolverError(f"no finite covariance exists. {objective.diagnose(state)}") from None
    if np.diag(factor[0]).min(initial=1.0) < 1e-7:
        raise SolverError("no finite covariance exists: a gauge freedom is left; fix a pose or the scale")
    columns = objective.columns.get(variable, np.full((len(state[variable]), variable.dim), -1))
    chosen = columns if rows is None else columns[rows]
    out = np.zeros((len(chosen), variable.dim, variable.dim))
    for row, column in enumerate(chosen):
        free = np.flatnonzero(column >= 0)
        unit = np.zeros((len(scale), len(free)))
        unit[column[free], np.arange(len(free))] = 1.0 / scale[column[free]]
        solved = scipy.linalg.cho_solve(factor, unit)[column[free]] / scale[column[free], None]
        out[row][np.ix_(free, free)] = solved
    return out
