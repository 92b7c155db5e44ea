r"""Taking variables out of a problem and leaving what they said as a linear prior on the others.

The factors that read a leaving variable are linearized once, at the current state. The landmarks among the
leaving are eliminated first (they are block-diagonal), then the leaving cameras by a dense Schur complement,

    H = H_rr - H_rm H_mm^{-1} H_mr,     g = g_r - H_rm H_mm^{-1} g_m,

and (H, g) is kept as ``R d + q`` with ``R^T R = H``, ``R^T q = g``
(see :mod:`uni4d_fg.factors.marginalization_prior`). For linear factors nothing is lost: solving what is left gives
what the whole problem gives. For others the linearization stays where it was. The factors that remain are linearized
at the current estimate, not at that point: the first estimate of a variable is the point that its prior was made at,
so that the prior itself never moves to another one, but live factors keep their convergence. Evaluating both at first
estimates guards directions that no factor observes against information that is not there; here none is unobserved,
because the first pose is held and the depth prior holds the scale, and a window is solved before anything leaves it.
Source: Dong-Si and Mourikis 2011, "Motion tracking with fixed-lag smoothing: algorithm and consistency analysis".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.marginalization_prior import marginalization_prior_type
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.factors.variable_types import LANDMARK
from uni4d_fg.optim.cluster_robust import Clusters, Spread, gradient_spread
from uni4d_fg.optim.marginals import reduced_hessian
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.threads import one_blas_thread

_RELATIVE_ZERO = 1e-12
"""Eigenvalues of the scaled information below this part of the largest carry no information."""
_POINT_RELATIVE_ZERO = 1e-9


def determined_points(batches: tuple[FactorBatch, ...], state: State, variable: VariableType = LANDMARK) -> BoolArray:
    """Return which points (N,) of a variable the factors determine when everything else is held."""
    hessian = np.zeros((len(state[variable]), 3, 3))
    for batch in batches:
        slots = [i for i, s in enumerate(batch.slots) if s.variable == variable]
        if not slots or len(batch) == 0:
            continue
        _, jacobians = batch.linearize(state)
        for i in slots:
            np.add.at(hessian, batch.slots[i].rows, np.swapaxes(jacobians[i], 1, 2) @ jacobians[i])
    values = np.linalg.eigvalsh(hessian)
    result: BoolArray = values[:, 0] > _POINT_RELATIVE_ZERO * np.maximum(values[:, 2], 1e-300)
    return result


def marginalize(
    batches: tuple[FactorBatch, ...],
    state: State,
    free: Mapping[VariableType, BoolArray],
    leaving: Mapping[VariableType, BoolArray],
    config: SolverConfig,
    eliminate: VariableType | None = LANDMARK,
) -> FactorBatch | None:
    """Turn factors into a linear prior on the variables that stay, see :func:`marginalize_with_spread`."""
    found = marginalize_with_spread(batches, state, free, leaving, config, eliminate)
    return None if found is None else found[0]


def marginalize_with_spread(
    batches: tuple[FactorBatch, ...],
    state: State,
    free: Mapping[VariableType, BoolArray],
    leaving: Mapping[VariableType, BoolArray],
    config: SolverConfig,
    eliminate: VariableType | None = LANDMARK,
    clusters: Clusters | None = None,
    carried: Spread | None = None,
) -> tuple[FactorBatch, Spread | None] | None:
    """Turn factors into a linear prior on the variables that stay, and say how uncertain it is.

    Args:
        batches: The factors to use up: every one that reads a leaving variable, and no other.
        state: Linearization point.
        free: Free entries per camera variable (n, dim); entries that are not free are constants. Points of
            ``eliminate`` that the batches read all leave.
        leaving: Rows (n,) per camera variable that leave.
        config: Options of the solver.
        eliminate: Group of points that leave.
        clusters: Which of these points may err alike.
        carried: Spread of a linear prior among the batches, on the columns of its slots.

    Returns:
        A batch of one factor on the rows that stay and that the information touches, and the spread of its gradient
        on the columns of its slots (None without clusters); None if there is no such row.

    Raises:
        SolverError: If a factor is not finite.
    """
    batches = tuple(batch for batch in batches if len(batch))
    if eliminate is not None and eliminate in state.arrays:
        known = determined_points(batches, state, eliminate)
        batches = tuple(_with_points(batch, known, eliminate) for batch in batches)
        free = {**free, eliminate: np.tile(known[:, None], (1, 3))}
    reduced = reduced_hessian(Problem(batches, free), state, config, eliminate)
    if reduced is None:
        return None
    layout, hessian, gradient = reduced
    is_leaving = np.zeros(layout.size, dtype=bool)
    for variable, rows in leaving.items():
        if variable in layout.offset:
            is_leaving[layout.columns(variable, np.flatnonzero(rows)).reshape(-1)] = True
    touched = layout.free & (np.abs(hessian).max(axis=1, initial=0.0) > 0.0)
    out = np.flatnonzero(is_leaving & touched)
    stay = np.flatnonzero(~is_leaving & touched)
    if len(stay) == 0:
        return None
    information, slope, step = _eliminate(hessian, gradient, stay, out)
    places = {layout.locate(column)[:2] for column in stay.tolist()}
    variables = sorted(places, key=lambda place: (place[0].name, place[1]))
    columns = np.concatenate([layout.columns(variable, np.array([row])).reshape(-1) for variable, row in variables])
    place = np.searchsorted(stay, columns)
    held = (place >= len(stay)) | (stay[np.minimum(place, len(stay) - 1)] != columns)
    root, offset = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
    at = np.flatnonzero(~held)
    part, _, offset_part = _square_root(information[np.ix_(place[at], place[at])], slope[place[at]])
    root[np.ix_(at, at)], offset[at] = part, offset_part
    slots = tuple(Slot(variable, np.array([row])) for variable, row in variables)
    points = {f"point_{i}": state[variable][[row]].copy() for i, (variable, row) in enumerate(variables)}
    family = marginalization_prior_type(tuple(variable for variable, _ in variables))
    prior = FactorBatch.create(family, slots, {"root": root[None], "offset": offset[None], **points})
    if clusters is None or eliminate is None:
        return prior, None
    spread = gradient_spread(batches, state, layout, clusters, eliminate, carried, as_prior=True)
    onto = np.zeros((layout.size, len(columns)))
    onto[stay[place[at]], at] = 1.0
    onto[np.ix_(out, at)] = -step[:, place[at]]
    return prior, spread.project(onto)


def _with_points(batch: FactorBatch, known: BoolArray, variable: VariableType) -> FactorBatch:
    """Leave out the factors on points that they do not determine: such a point carries nothing to the cameras."""
    rows = next((s.rows for s in batch.slots if s.variable == variable), None)
    return batch if rows is None or known[rows].all() else batch.take(np.flatnonzero(known[rows]))


def _eliminate(
    hessian: FloatArray, gradient: FloatArray, stay: IntArray, out: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the Schur complement and its gradient on the columns that stay, and ``H_oo^{-1} H_os``.

    Leaving directions that no factor determines are left out of the inverse: they carry nothing.
    """
    information, slope = hessian[np.ix_(stay, stay)], gradient[stay]
    step = np.zeros((len(out), len(stay)))
    if len(out) == 0:
        return information, slope, step
    with one_blas_thread():
        _, inverse, offset = _square_root(hessian[np.ix_(out, out)], gradient[out])
        link = inverse.T @ hessian[np.ix_(out, stay)]
        information = information - link.T @ link
        slope = slope - link.T @ offset
        step = inverse @ link
    return 0.5 * (information + information.T), slope, step


def _square_root(information: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return R, its pseudo-inverse, and q with R^T R = information and R^T q = gradient; rounding is cut off."""
    if len(information) == 0:
        return information, information, gradient
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / scale[:, None] / scale)
    keep = values > _RELATIVE_ZERO * max(float(values[-1]), 0.0)
    square = np.where(keep, np.sqrt(np.where(keep, values, 1.0)), 0.0)
    root: FloatArray = square[:, None] * vectors.T * scale
    inverse = np.where(keep, 1.0 / np.where(keep, square, 1.0), 0.0)
    offset: FloatArray = inverse * (vectors.T @ (gradient / scale))
    inverse_root: FloatArray = (vectors / scale[:, None]) * inverse
    return root, inverse_root, offset
