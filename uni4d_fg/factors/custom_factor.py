"""The thin GTSAM adaptor: a factor batch as ``gtsam.CustomFactor`` objects, one per row or stacked.

Stacking (all observations of a landmark in one factor, say) saves most of the cost of Python callbacks. The
robust kernel is carried in square-root form inside the factor, row by row, because GTSAM's robust noise
models see a stacked residual as one. ``gtsam`` measures ``|r|^2 / 2``, which is the batch's energy exactly.

Inside GTSAM's own optimisers each callback copies the whole ``Values``: cost is quadratic in the number of
variables. Use :class:`uni4d_fg.solve.gaussian_graph.GraphObjective`, whose cost is linear.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import TANGENT_DIM, State, values_at

CALIBRATION_ENTRIES = [0, 1, 3, 4]
"""Where fx, fy, cx, cy stand in the vector of a ``gtsam.Cal3_S2``; entry 2 is the skew."""


def to_factor_graph(
    problem: Problem, state: State, stack_by: dict[str, str] | None = None
) -> gtsam.NonlinearFactorGraph:
    """Present a problem as a factor graph of custom factors.

    Rows that are only partly free (a focal length without its principal point) are not expressible this way
    and are treated as free; freeze them with a prior.

    Args:
        problem: Batches and free entries; rows of frozen variables are taken from ``state`` as constants.
        state: Values of the frozen variables, and the names of all.
        stack_by: Per term name the group whose row collects factors into one (``{"static_reprojection":
            "landmark"}``); one factor per row otherwise.

    Returns:
        A graph on the keys of :mod:`uni4d_fg.graph.keys`.

    Raises:
        SolverError: If a term does not read the group it is to be stacked by.
    """
    graph = gtsam.NonlinearFactorGraph()
    free = problem.free_rows()
    for batch in problem.batches:
        for rows in _stacks(batch, (stack_by or {}).get(batch.name)):
            factor = make_custom_factor(batch.take(rows), state, free)
            if factor is not None:
                graph.push_back(factor)
    return graph


def _stacks(batch: FactorBatch, group: str | None) -> list[IntArray]:
    if group is None:
        return list(np.arange(len(batch)).reshape(-1, 1))
    if all(s.group != group for s in batch.slots):
        raise SolverError(f"{batch.name}: cannot be stacked by {group}, which it does not read")
    of_row = next(s.rows for s in batch.slots if s.group == group)
    order = np.argsort(of_row, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(of_row[order])) + 1) if len(order) else []


def make_custom_factor(
    batch: FactorBatch, state: State, free: dict[str, BoolArray], *, calibrations: bool = False
) -> gtsam.CustomFactor | None:
    """Stack all rows of a batch into one custom factor; None when it reads no free variable.

    Args:
        batch: Rows to stack.
        state: Values of the frozen variables, and the names of all.
        free: Per group the rows (n,) that may move.
        calibrations: Whether intrinsics are ``gtsam.Cal3_S2`` in the values rather than 4-vectors.
    """
    variables: dict[int, tuple[str, int]] = {}
    for slot in batch.slots:
        if slot.group in free:
            for row in np.unique(slot.rows[free[slot.group][slot.rows]]).tolist():
                variables[state.key(slot.group, row)] = (slot.group, row)
    if not variables:
        return None
    keys = list(variables)
    position = {variable: i for i, variable in enumerate(variables.values())}
    dimension = len(batch) * batch.family.residual_dim
    noise = gtsam.noiseModel.Unit.Create(dimension)
    callback = _callback(batch, state, keys, list(variables.values()), position, calibrations)
    return gtsam.CustomFactor(noise, keys, callback)


def _callback(
    batch: FactorBatch,
    state: State,
    keys: list[int],
    variables: list[tuple[str, int]],
    position: dict[tuple[str, int], int],
    calibrations: bool,
) -> Callable[[Any, gtsam.Values, list[FloatArray] | None], FloatArray]:
    slot_rows = [np.unique(s.rows, return_inverse=True) for s in batch.slots]
    constants = [state[s.group][unique] for s, (unique, _) in zip(batch.slots, slot_rows, strict=True)]

    def error(this: Any, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        arguments = []
        for slot, (unique, inverse), constant in zip(batch.slots, slot_rows, constants, strict=True):
            current = constant.copy()
            for i, row in enumerate(unique.tolist()):
                if (slot.group, row) in position:
                    key = keys[position[slot.group, row]]
                    if calibrations and slot.group == "intrinsics":
                        current[i] = values.atCal3_S2(key).vector()[CALIBRATION_ENTRIES]
                    else:
                        current[i] = values_at(values, key, slot.group)
            arguments.append(current[inverse])
        if jacobians is None:
            r, _ = _robust_square_root(batch, batch.family.residual(*arguments, **batch.data), [])
        else:
            r, blocks = batch.family.linearize(*arguments, **batch.data)
            batch.check(r, blocks, state)  # GTSAM would accept a wrong shape and a NaN
            r, blocks = _robust_square_root(batch, r, blocks)
            rows, d = r.shape
            for i, (group, _) in enumerate(variables):
                width = 5 if calibrations and group == "intrinsics" else TANGENT_DIM[group]
                jacobians[i] = np.zeros((rows * d, width), order="F")
            for slot, block in zip(batch.slots, blocks, strict=True):
                for n, row in enumerate(slot.rows.tolist()):
                    if (slot.group, row) in position:
                        target = jacobians[position[slot.group, row]][n * d : (n + 1) * d]
                        if calibrations and slot.group == "intrinsics":
                            target[:, CALIBRATION_ENTRIES] += block[n]
                        else:
                            target += block[n]
        return r.reshape(-1)

    return error


def _robust_square_root(
    batch: FactorBatch, r: FloatArray, blocks: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return a(s) r and its exact Jacobians, with |a r|^2 / 2 = weight rho(s)."""
    inverse_sigma = 1.0 / (batch.sigma[:, None] if batch.sigma.ndim == 1 else batch.sigma)
    white = r * inverse_sigma
    a, slope = batch.kernel.square_root(np.einsum("nd,nd->n", white, white))
    root_weight = np.sqrt(batch.weight)
    out = []
    for block in blocks:
        white_block = block * inverse_sigma[:, :, None]
        radial = np.einsum("nd,ndk->nk", white, white_block)
        full = a[:, None, None] * white_block + (slope[:, None] * white)[:, :, None] * radial[:, None, :]
        out.append(root_weight[:, None, None] * full)
    return (root_weight * a)[:, None] * white, out
