"""Why a linear system is singular, in words: which variables no factor determines."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType
from uni4d_fg.optim.problem import Problem

_RELATIVE_ZERO = 1e-10
"""Information below this part of the largest is rounding."""
_LISTED = 5

GAUGE_MESSAGE = (
    "No single variable is undetermined: a gauge freedom or parallel constraints remain; anchor a pose or the scale."
)


def undetermined(blocks: FloatArray, free: BoolArray | None = None) -> IntArray:
    """Return the variables whose own block of the Hessian is singular.

    The Hessian is a sum of squares: where a diagonal block is singular, so is the whole. The converse does
    not hold, because a gauge freedom leaves every block regular.

    Args:
        blocks: (n, k, k) undamped diagonal blocks of n variables of one variable.
        free: (n, k) entries that may move; all of them when None.

    Returns:
        Rows, ascending.
    """
    n, k, _ = blocks.shape
    movable: BoolArray = np.ones((n, k), dtype=bool) if free is None else free
    diagonal: FloatArray = np.diagonal(blocks, axis1=1, axis2=2)
    largest = max(float(np.nan_to_num(np.abs(diagonal[movable]), posinf=0.0).max(initial=0.0)), 1e-300)
    weak: BoolArray = np.asarray(movable & ~(diagonal > 1e-12 * largest))
    broken: BoolArray = np.asarray(~np.isfinite(blocks).all(axis=(1, 2)))
    usable = movable & ~weak & ~broken[:, None]
    # Unit diagonal, so that entries of different units compare; entries that cannot move decouple.
    scale = np.where(usable, 1.0 / np.sqrt(np.where(usable, diagonal, 1.0)), 0.0)
    scaled = np.where(broken[:, None, None], 0.0, blocks) * scale[:, :, None] * scale[:, None, :]
    index = np.arange(k)
    scaled[:, index, index] = 1.0
    smallest = np.linalg.eigvalsh(scaled)[:, 0] if n and k else np.ones(n)
    return np.flatnonzero(weak.any(axis=1) | broken | (smallest < _RELATIVE_ZERO))


def undetermined_message(problem: Problem, state: State, variables: list[tuple[VariableType, int]]) -> str:
    """Return a sentence that names undetermined variables (variable, row) and the terms that read them."""
    described = []
    for variable, row in variables[:_LISTED]:
        terms = {
            batch.name
            for batch in problem.batches
            for s in batch.slots
            if s.variable == variable and (s.rows == row).any()
        }
        described.append(f"{state.describe(variable, row)} (factors: {', '.join(sorted(terms)) or 'none'})")
    return listing(described, len(variables))


def listing(described: list[str], count: int) -> str:
    """Return the sentence of :func:`undetermined_message` for variables that are described already."""
    if not described:
        return GAUGE_MESSAGE
    more = f"; and {count - len(described)} more" if count > len(described) else ""
    return f"Not determined: {'; '.join(described)}{more}. Give them observations or a prior, or freeze them."


def null_directions_message(
    hessian: FloatArray, diagonal: FloatArray, names: list[str], max_size: int = 2000
) -> str | None:
    """Return a sentence on the directions along which a dense Hessian is flat; None if there is none.

    Args:
        hessian: (n, n) undamped, other variables eliminated.
        diagonal: (n,) its diagonal before they were eliminated.
        names: Name of the variable of each column.
        max_size: Larger systems are not analysed.
    """
    if not 0 < len(hessian) <= max_size or not np.isfinite(hessian).all():
        return None
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-300))
    values, vectors = np.linalg.eigh(hessian * scale[:, None] * scale)
    flat = vectors[:, values < _RELATIVE_ZERO]
    if flat.shape[1] == 0:
        return None
    share: dict[str, float] = {}
    for name, weight in zip(names, np.sum(flat**2, axis=1).tolist(), strict=True):
        share[name] = share.get(name, 0.0) + weight
    most = sorted(share, key=lambda name: -share[name])[:_LISTED]
    return (
        f"Every variable is determined on its own, but not all together (free joint directions: {flat.shape[1]}, "
        f"mostly of {'; '.join(most)}): anchor a pose or the scale."
    )
