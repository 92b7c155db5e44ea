r"""Covariances that allow for constants which are not known exactly.

A solve holds a variable k at a value whose covariance P is known from elsewhere: a prior, or an earlier solve that
fixed it. The others follow it by

    d x / d k = S = -A_xx^{-1} A_xk,       cov(x) = cov(x given k) + S P S^T,

with the blocks of the reduced Hessian in which k is free (landmarks follow too). Left out, an error of k would count as
none however large it is.
Source: Schmidt 1966, "Application of state-space methods to navigation problems" (consider covariance).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.cluster_robust import MIN_CLUSTERS, Clusters, Spread, curvature_batch, gradient_spread, steadied
from uni4d_fg.optim.marginals import CameraMarginals, inverse_of_positive_definite, reduced_hessian
from uni4d_fg.optim.problem import Problem


@dataclass(frozen=True)
class Considered:
    """A variable of one row that a solve holds."""

    variable: VariableType
    covariance: FloatArray
    """(d, d) of its value; zero where it is known exactly."""


def considered_marginals(
    problem: Problem,
    state: State,
    config: SolverConfig,
    clusters: Clusters | None,
    eliminate: VariableType,
    considered: Considered,
    carried: Spread | None = None,
) -> CameraMarginals | None:
    """Return the joint covariance of the cameras at a solution that held a variable.

    Args:
        problem: Factors and free entries of the solve, except that the variable is free in it.
        state: The solution.
        config: Options of the solve.
        clusters: Of the landmarks, see :mod:`uni4d_fg.optim.cluster_robust`; None counts errors as independent.
        eliminate: Group of the landmarks.
        considered: The variable.
        carried: Spread that belongs to a linear prior among the factors.

    Returns:
        None if the factors do not determine every free entry.

    Raises:
        SolverError: If a factor is not finite.
    """
    batches = problem.batches
    if clusters is not None:
        batches = tuple(curvature_batch(batch, state) for batch in batches)
    reduced = reduced_hessian(Problem(batches, problem.free), state, config, eliminate)
    if reduced is None:
        return None
    layout, hessian, _ = reduced
    held = layout.columns(considered.variable, np.zeros(1, dtype=np.int64))[0]
    free = layout.free.copy()
    free[held] = False
    at = np.flatnonzero(free)
    inverse = inverse_of_positive_definite(hessian[np.ix_(at, at)])
    if inverse is None:
        return None
    covariance = np.zeros_like(hessian)
    covariance[np.ix_(at, at)] = inverse
    marginals = CameraMarginals(layout, covariance)
    if clusters is not None:
        spread = gradient_spread(problem.batches, state, layout, clusters, eliminate, carried)
        if spread.num_used >= MIN_CLUSTERS:
            marginals = steadied(marginals, spread)
    follows = np.zeros((layout.size, len(held)))
    follows[at] = -inverse @ hessian[np.ix_(at, held)]
    follows[held, np.arange(len(held))] = 1.0
    return replace(marginals, covariance=marginals.covariance + follows @ considered.covariance @ follows.T)
