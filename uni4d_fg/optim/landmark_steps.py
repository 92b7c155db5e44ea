"""Points that are eliminated, each moved to its own minimum while all other variables rest: embedded point iterations.

Points have nothing to do with each other then: each has its own damping and its own decision on every step, and the
model of a step knows the curvature of the robust kernels. A Levenberg-Marquardt loop over everything has one damping
for all, and creeps while few points still change sides of a kernel. The C++ twin is ``landmark_points.cpp``.
Source: Jeong et al. 2012, "Pushing the envelope of modern methods for bundle adjustment".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray, sum_rows
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType

_KERNEL_CURVATURE = 0.9
"""Part of the kernels' falloff that the model of a step accounts for."""
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-9, 1e6
_DAMPING_FACTOR = 8.0
_LEAST_DECREASE = 1e-8
"""A point rests once a step lowers its energy by less than this part."""


def settle_points(
    batches: Sequence[FactorBatch], state: State, variable: VariableType, free: BoolArray, config: SolverConfig
) -> State:
    """Return the state with every free point moved by up to ``config.landmark_steps``; no step raises its energy.

    Args:
        batches: Factors that read one point each; others are not looked at.
        state: Where the points start and everything else rests.
        variable: Type of the points, 3-vectors.
        free: (N,) which points may move.
        config: Number of steps, bounds of the damping diagonal.
    """
    pulls = [(b, s.rows) for b in batches if len(b) for s in b.slots if s.variable is variable]
    points = state[variable].copy()
    energy = _energies(pulls, state, len(points))
    damping, moving = np.full(len(points), _FIRST_DAMPING), free & np.isfinite(energy)
    axis = np.arange(3)
    for _ in range(config.landmark_steps):
        if not moving.any():
            break
        hessian, gradient = _systems(pulls, state.replace({variable: points}), variable, moving)
        diagonal = np.clip(hessian[:, axis, axis], config.min_diagonal, config.max_diagonal)
        hessian[:, axis, axis] += damping[:, None] * diagonal
        hessian[~moving] = np.eye(3)
        tried = points - np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
        tried[~moving] = points[~moving]
        now = _energies(pulls, state.replace({variable: tried}), len(points))
        better = moving & (now < energy)
        rests = better & (energy - now < _LEAST_DECREASE * energy)
        points, energy = np.where(better[:, None], tried, points), np.where(better, now, energy)
        damping = np.where(better, np.maximum(damping / _DAMPING_FACTOR, _LEAST_DAMPING), damping * _DAMPING_FACTOR)
        moving &= ~(rests | (damping > _MOST_DAMPING))
    return state.replace({variable: points})


def _energies(pulls: list[tuple[FactorBatch, IntArray]], state: State, count: int) -> FloatArray:
    """Return the energy of the factors on each point, (N,)."""
    out = np.zeros(count)
    with np.errstate(all="ignore"):
        for batch, rows in pulls:
            out += np.bincount(rows, batch.weight * batch.kernel.rho(batch.squared_norm(state)), count)
    return out


def _systems(
    pulls: list[tuple[FactorBatch, IntArray]], state: State, variable: VariableType, wanted: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return curved Hessians (N, 3, 3) and gradients (N, 3) of the wanted points; 0 of others."""
    hessian, gradient = np.zeros((len(wanted), 9)), np.zeros((len(wanted), 3))
    for whole, of_all in pulls:
        batch = whole.take(np.flatnonzero(wanted[of_all]))
        at = next(i for i, s in enumerate(batch.slots) if s.variable is variable)
        rows = batch.slots[at].rows
        r, jacobians = batch.linearize(state, _KERNEL_CURVATURE)
        point = np.swapaxes(jacobians[at], 1, 2)
        product, slope = (point @ jacobians[at]).reshape(-1, 9), (point @ r[:, :, None])[:, :, 0]
        hessian += sum_rows(product, rows, len(wanted))
        gradient += sum_rows(slope, rows, len(wanted))
    return hessian.reshape(-1, 3, 3), gradient
