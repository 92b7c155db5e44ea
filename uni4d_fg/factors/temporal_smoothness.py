r"""Temporal smoothness of a dynamic point.

    first difference   r = p_{k,t+1} - p_{k,t}                    [m per frame], 3-vector (Uni4D, E_smooth)
    second difference  r = p_{k,t+1} - 2 p_{k,t} + p_{k,t-1}      [m per frame^2], 3-vector (constant velocity)

Points in the world. Both are linear: their Jacobians are constant.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.family import FactorFamily


def velocity_residual(now: Array, after: Array) -> Array:
    """Return (N, 3) of p_{k,t} and p_{k,t+1}, each (N, 3)."""
    return after - now


def velocity_linearize(now: FloatArray, after: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the two Jacobians, each (N, 3, 3)."""
    return after - now, [_scaled_identity(-1.0, len(now)), _scaled_identity(1.0, len(now))]


def acceleration_residual(before: Array, now: Array, after: Array) -> Array:
    """Return (N, 3) of p_{k,t-1}, p_{k,t} and p_{k,t+1}, each (N, 3)."""
    return after - 2.0 * now + before


def acceleration_linearize(
    before: FloatArray, now: FloatArray, after: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the three Jacobians, each (N, 3, 3)."""
    n = len(now)
    return after - 2.0 * now + before, [_scaled_identity(s, n) for s in (1.0, -2.0, 1.0)]


def _scaled_identity(scale: float, count: int) -> FloatArray:
    return np.broadcast_to(scale * np.eye(3), (count, 3, 3))


VELOCITY_SMOOTHNESS = FactorFamily(
    name="smoothness",
    variables=("dynamic_point",) * 2,
    data=(),
    residual_dim=3,
    residual=velocity_residual,
    linearize=velocity_linearize,
)

ACCELERATION_SMOOTHNESS = FactorFamily(
    name="smoothness",
    variables=("dynamic_point",) * 3,
    data=(),
    residual_dim=3,
    residual=acceleration_residual,
    linearize=acceleration_linearize,
)
