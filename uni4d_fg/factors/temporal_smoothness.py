r"""Temporal smoothness of a dynamic point.

    first difference   r = p_{k,t+1} - p_{k,t}                    [m per frame], 3-vector (Uni4D, E_smooth)
    second difference  r = p_{k,t+1} - 2 p_{k,t} + p_{k,t-1}      [m per frame^2], 3-vector (constant velocity)

Points in the world. Both are linear: their Jacobians are constant.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.factor_type import NativeRow, factor
from uni4d_fg.factors.variable_types import DYNAMIC_POINT


def native_velocity(row: NativeRow) -> Any:
    """Return GTSAM's relative position of zero."""
    now, after = row.keys
    return gtsam.BetweenFactorPoint3(now, after, np.zeros(3), row.noise)


@factor(DYNAMIC_POINT, DYNAMIC_POINT, dim=3, term="smoothness", stack=0, native=native_velocity)
def velocity_smoothness(now: Array, after: Array) -> Array:
    """Return (N, 3) of p_{k,t} and p_{k,t+1}, each (N, 3)."""
    return after - now


@velocity_smoothness.jacobian
def velocity_smoothness_jacobian(now: FloatArray, after: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the two Jacobians, each (N, 3, 3)."""
    return after - now, [_scaled_identity(-1.0, len(now)), _scaled_identity(1.0, len(now))]


@factor(DYNAMIC_POINT, DYNAMIC_POINT, DYNAMIC_POINT, dim=3, term="smoothness", stack=0)
def acceleration_smoothness(before: Array, now: Array, after: Array) -> Array:
    """Return (N, 3) of p_{k,t-1}, p_{k,t} and p_{k,t+1}, each (N, 3)."""
    return after - 2.0 * now + before


@acceleration_smoothness.jacobian
def acceleration_smoothness_jacobian(
    before: FloatArray, now: FloatArray, after: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the three Jacobians, each (N, 3, 3)."""
    n = len(now)
    return after - 2.0 * now + before, [_scaled_identity(s, n) for s in (1.0, -2.0, 1.0)]


def _scaled_identity(scale: float, count: int) -> FloatArray:
    return np.broadcast_to(scale * np.eye(3), (count, 3, 3))
