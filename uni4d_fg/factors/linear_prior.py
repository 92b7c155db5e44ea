r"""What marginalised variables leave behind: one linear factor on all the variables they were linked to.

    r = R d + q,     d = (x_1 - x_1^0, ..., x_m - x_m^0)   in the tangent of each variable        [whitened]

``R`` (n, n) is a square root of the information and ``q`` its offset at the linearisation point x^0, which stays
fixed. A pose's difference is Log(T_0^{-1} T) of SE(3), body frame, rotation first; its Jacobian is the inverse
right Jacobian of SE(3). The factor reads any number of poses, log-scales and intrinsics, so that its family is
made for each prior (:func:`linear_prior_family`).
Source: Sibley, Matthies and Sukhatme 2010, "Sliding window filter with application to planetary landing".
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.family import FactorFamily
from uni4d_fg.geometry import se3
from uni4d_fg.graph.state import TANGENT_DIM

LINEAR_PRIOR = "linear_prior"
"""Name of every such family."""
_SMALL_ANGLE = 1e-4


def se3_log(transform: FloatArray) -> FloatArray:
    """Return twists (N, 6) = (omega [rad], v [m]) with ``se3_exp(twist) == transform`` (N, 4, 4)."""
    omega = se3.so3_log(transform[:, :3, :3])
    w = se3.skew(omega)
    v = (_inverse_left(omega, w) @ transform[:, :3, 3, None])[:, :, 0]
    return np.concatenate([omega, v], axis=1)


def _inverse_left(omega: FloatArray, w: FloatArray) -> FloatArray:
    """Return the inverse left Jacobian of SO(3), (N, 3, 3)."""
    angle = np.linalg.norm(omega, axis=1)
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    coefficient = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    result: FloatArray = np.eye(3) - 0.5 * w + coefficient[:, None, None] * (w @ w)
    return result


def inverse_right_jacobian(twist: FloatArray) -> FloatArray:
    """Return J with ``Log(Exp(twist) Exp(d)) = twist + J d + O(d^2)``, (N, 6, 6), for twists (N, 6) below pi.

    The Bernoulli series of ad(twist); a prior's differences are small, so that it ends early.
    """
    ad = np.zeros((len(twist), 6, 6))
    w, v = se3.skew(twist[:, :3]), se3.skew(twist[:, 3:])
    ad[:, :3, :3], ad[:, 3:, 3:], ad[:, 3:, :3] = w, w, v
    squared = ad @ ad
    fourth = squared @ squared
    result: FloatArray = (
        np.eye(6)
        + 0.5 * ad
        + squared / 12.0
        - fourth / 720.0
        + fourth @ squared / 30240.0
        - fourth @ fourth / 1209600.0
    )
    return result


def linear_prior_family(variables: tuple[str, ...]) -> FactorFamily:
    """Return the family of linear priors on the given variable groups, one slot each.

    Its data are ``root`` (N, n, n), ``offset`` (N, n) and the linearisation points ``point_0``, ``point_1``, ...
    """
    names = tuple(f"point_{i}" for i in range(len(variables)))
    size = sum(TANGENT_DIM[group] for group in variables)

    def difference(values: tuple[Array, ...], data: dict[str, FloatArray]) -> FloatArray:
        parts = []
        for group, name, value in zip(variables, names, values, strict=True):
            point = data[name]
            parts.append(se3_log(se3.inverse(point) @ value) if group == "pose" else value - point)
        return np.concatenate([np.zeros((len(data["offset"]), 0)), *parts], axis=1)

    def residual(*values: Array, **data: FloatArray) -> Array:
        d = difference(values, data)
        return np.einsum("nij,nj->ni", data["root"], d) + data["offset"]

    def linearize(*values: FloatArray, **data: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        d = difference(values, data)
        jacobians, start = [], 0
        for group in variables:
            stop = start + TANGENT_DIM[group]
            block = data["root"][:, :, start:stop]
            jacobians.append(block @ inverse_right_jacobian(d[:, start:stop]) if group == "pose" else block)
            start = stop
        return np.einsum("nij,nj->ni", data["root"], d) + data["offset"], jacobians

    return FactorFamily(LINEAR_PRIOR, variables, ("root", "offset", *names), size, residual, linearize)
