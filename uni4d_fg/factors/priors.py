r"""Priors that anchor what the images leave free.

intrinsics   r = K - K_0                                [px], 4-vector
log-scale    r = s_t - s_0                              [dimensionless], 1-vector
scale        r = log(|c_a - c_b| / distance)            [dimensionless], 1-vector: fixes the scale of a
reconstruction that no depth prior holds
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.family import FactorFamily

_MIN_DISTANCE = 1e-9


def difference_residual(variable: Array, *, measured: Array) -> Array:
    """Return variable - measured, (N, d)."""
    return variable - measured


def difference_linearize(variable: FloatArray, *, measured: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobian, the identity (N, d, d)."""
    n, d = variable.shape
    return variable - measured, [np.broadcast_to(np.eye(d), (n, d, d))]


def scale_residual(first: Array, second: Array, *, distance: Array) -> Array:
    """Return (N, 1) of two poses (N, 4, 4) and the distance of their centres (N,), m."""
    xp = namespace(first)
    d = second[..., :3, 3] - first[..., :3, 3]
    length = xp.sqrt(xp.sum(d * d, axis=-1) + _MIN_DISTANCE**2)
    return xp.log(length / distance)[..., None]


def scale_linearize(
    first: FloatArray, second: FloatArray, *, distance: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and the Jacobians of both poses, each (N, 1, 6)."""
    d = second[:, :3, 3] - first[:, :3, 3]
    squared = np.sum(d * d, axis=-1) + _MIN_DISTANCE**2
    by_center = (d / squared[:, None])[:, None, :]
    jacobians = [np.zeros((len(d), 1, 6)) for _ in range(2)]
    jacobians[0][:, :, 3:] = -by_center @ first[:, :3, :3]
    jacobians[1][:, :, 3:] = by_center @ second[:, :3, :3]
    return (0.5 * np.log(squared) - np.log(distance))[:, None], jacobians


def aspect_residual(intrinsics: Array, *, measured: Array) -> Array:
    """Return (N, 1) of intrinsics (N, 4) and the measured log(fx / fy) (N,)."""
    xp = namespace(intrinsics)
    return (xp.log(intrinsics[..., 0]) - xp.log(intrinsics[..., 1]) - measured)[..., None]


def aspect_linearize(intrinsics: FloatArray, *, measured: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobian (N, 1, 4)."""
    jacobian = np.zeros((len(intrinsics), 1, 4))
    jacobian[:, 0, 0] = 1.0 / intrinsics[:, 0]
    jacobian[:, 0, 1] = -1.0 / intrinsics[:, 1]
    return aspect_residual(intrinsics, measured=measured), [jacobian]


ASPECT_PRIOR = FactorFamily(
    name="aspect_prior",
    variables=("intrinsics",),
    data=("measured",),
    residual_dim=1,
    residual=aspect_residual,
    linearize=aspect_linearize,
)

INTRINSICS_PRIOR = FactorFamily(
    name="intrinsics_prior",
    variables=("intrinsics",),
    data=("measured",),
    residual_dim=4,
    residual=difference_residual,
    linearize=difference_linearize,
)

LOG_SCALE_PRIOR = FactorFamily(
    name="log_scale_prior",
    variables=("log_scale",),
    data=("measured",),
    residual_dim=1,
    residual=difference_residual,
    linearize=difference_linearize,
)

SCALE_ANCHOR = FactorFamily(
    name="scale_anchor",
    variables=("pose", "pose"),
    data=("distance",),
    residual_dim=1,
    residual=scale_residual,
    linearize=scale_linearize,
)
