r"""As-rigid-as-possible: the distance of two neighboring dynamic points does not change from frame to frame.

    r = d(p_{k,t}, p_{m,t}) - d(p_{k,t+1}, p_{m,t+1}),   d(p, q) = sqrt(|p - q|^2 + epsilon^2)   [m], 1-vector

Variables: the four points p_{k,t}, p_{m,t}, p_{k,t+1}, p_{m,t+1} (world). epsilon keeps the distance of two
coinciding points differentiable (its gradient is zero there). Source: Uni4D, E_arap; Sorkine and Alexa 2007.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.variable_types import DYNAMIC_POINT

DISTANCE_EPSILON = 1e-4
"""Smoothing of the distance, m."""


def smooth_distance(p: Array, q: Array) -> Array:
    """Return sqrt(|p - q|^2 + epsilon^2), (N,), of points (N, 3)."""
    xp = namespace(p)
    d = p - q
    return xp.sqrt(xp.sum(d * d, axis=-1) + DISTANCE_EPSILON**2)


@factor(DYNAMIC_POINT, DYNAMIC_POINT, DYNAMIC_POINT, DYNAMIC_POINT, dim=1, stack=0)
def arap(first: Array, second: Array, first_next: Array, second_next: Array) -> Array:
    """Return (N, 1) m of p_{k,t}, p_{m,t}, p_{k,t+1}, p_{m,t+1}, each (N, 3)."""
    return (smooth_distance(first, second) - smooth_distance(first_next, second_next))[..., None]


@arap.jacobian
def arap_jacobian(
    first: FloatArray, second: FloatArray, first_next: FloatArray, second_next: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the four Jacobians, each (N, 1, 3)."""
    now, after = smooth_distance(first, second), smooth_distance(first_next, second_next)
    direction_now = ((first - second) / now[:, None])[:, None, :]
    direction_after = ((first_next - second_next) / after[:, None])[:, None, :]
    r: FloatArray = np.asarray(now - after)[:, None]
    return r, [direction_now, -direction_now, -direction_after, direction_after]
