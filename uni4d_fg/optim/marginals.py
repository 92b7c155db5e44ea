r"""Marginal covariances of the cameras at the end of a bundle adjustment.

With the landmarks eliminated, the undamped Gauss-Newton Hessian of the cameras is

    S = H_cc - E V^{-1} E^T,        cov(d_c) = S^{-1}   on the free columns,

computed by Cholesky; d_c are tangent steps (poses: body-frame twists, rotation first). Frozen entries have zero
covariance, so that every pose is relative to the held one: the world's gauge is the first camera.

What this covariance means, and what it does not: it is the spread of the estimate over repeated noise if the
sigmas of the factors are the true ones and errors are independent. Robust kernels count with the weights they
have at the solution (iteratively reweighted least squares), so that observations a kernel trusts less inform
less. Errors of a depth cue that are alike over neighboring pixels or along a track are not seen except where
the sigma was widened for them, outliers that a kernel did not recognize are not seen at all, and the
linearization is that of the solution.
Source: Triggs et al. 2000, "Bundle adjustment - a modern synthesis", section 9; Kaess and Dellaert 2009.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import LANDMARK
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.optim.layout import DenseLayout
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.schur import SchurObjective
from uni4d_fg.optim.threads import one_blas_thread


@dataclass(frozen=True)
class CameraMarginals:
    """Joint covariance of the non-eliminated variables."""

    layout: DenseLayout
    covariance: FloatArray
    """(size, size) over the columns of the layout; zero rows and columns for frozen entries."""

    def blocks(self, variable: VariableType, count: int) -> FloatArray:
        """Return each row's own covariance, (count, d, d) for a variable of ``count`` rows; zero where it is frozen."""
        dim = variable.dim
        if variable not in self.layout.offset:
            return np.zeros((count, dim, dim))
        columns = self.layout.columns(variable, np.arange(count))
        result: FloatArray = self.covariance[columns[:, :, None], columns[:, None, :]]
        return result


def reduced_hessian(
    problem: Problem, state: State, config: SolverConfig, eliminate: VariableType | None = LANDMARK
) -> tuple[DenseLayout, FloatArray, FloatArray] | None:
    """Return the layout, S (size, size) and the reduced gradient (size,) at ``state``, without damping.

    Args:
        problem: Factors and free entries.
        state: Linearization point.
        config: Not used by an undamped system, but asked for by the objective.
        eliminate: Group of 3-vectors to eliminate.

    Returns:
        None if an eliminated point is not determined by its factors.

    Raises:
        SolverError: If a factor is not finite.
    """
    if find_extension()[0] is not None and eliminate is not None:
        from uni4d_fg.optim import cpp_schur

        problem = replace(problem, eliminated=eliminate)
        if not cpp_schur.refusal(problem, state):
            compiled = cpp_schur.CppSchurObjective(problem, state, config)
            linearization = compiled.linearize(state)
            system = linearization.reduced(0.0)
            if system is None:
                return None
            matrix, vector = linearization.dense(system)
            return compiled.layout, matrix, -vector
    objective = SchurObjective(problem, state, config, eliminate)
    reduced = objective.linearize(state).reduced(0.0)
    if reduced is None:
        return None
    hessian, right_hand_side, _ = reduced
    return objective.layout, hessian, -right_hand_side


def camera_marginals(
    problem: Problem, state: State, config: SolverConfig, eliminate: VariableType | None = LANDMARK
) -> CameraMarginals | None:
    """Return the joint covariance of the cameras at a solution.

    Args:
        problem: Factors and free entries of the solve.
        state: Its solution.
        config: Options of the solve.
        eliminate: Group of 3-vectors to eliminate.

    Returns:
        None if the factors do not determine every free entry: then no finite covariance exists.

    Raises:
        SolverError: If a factor is not finite.
    """
    reduced = reduced_hessian(problem, state, config, eliminate)
    if reduced is None:
        return None
    layout, hessian, _ = reduced
    covariance = np.zeros_like(hessian)
    free = np.flatnonzero(layout.free)
    inverse = inverse_of_positive_definite(hessian[np.ix_(free, free)])
    if inverse is None:
        return None
    covariance[np.ix_(free, free)] = inverse
    return CameraMarginals(layout, covariance)


def inverse_of_positive_definite(matrix: FloatArray) -> FloatArray | None:
    """Invert a symmetric matrix (n, n) by Cholesky; None if it is not safely positive definite.

    Rows and columns are scaled to a unit diagonal first, because radians, meters and pixels differ by orders of
    magnitude; a scaled pivot below 1e-7 counts as undetermined.
    """
    if len(matrix) == 0:
        return matrix.copy()
    diagonal = np.diag(matrix)
    if not (np.isfinite(diagonal).all() and (diagonal > 0).all()):
        return None
    scale = 1.0 / np.sqrt(diagonal)
    with one_blas_thread():
        factor, info = lapack.dpotrf(matrix * scale[:, None] * scale, lower=1, clean=1)
        if info != 0 or np.diag(factor).min() < 1e-7:
            return None
        lower, info = lapack.dpotri(factor, lower=1)
    if info != 0:
        return None
    inverse = np.tril(lower) + np.tril(lower, -1).T
    result: FloatArray = inverse * scale[:, None] * scale
    return result
