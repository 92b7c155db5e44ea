r"""What marginalized variables leave behind: one linear factor on all the variables they were linked to.

    r = R d + q,     d = (x_1 - x_1^0, ..., x_m - x_m^0)   in the tangent of each variable        [whitened]

``R`` (n, n) is a square root of the information and ``q`` its offset at the linearization point x^0, which stays
fixed. A pose's difference is Log(T_0^{-1} T) of SE(3), body frame, rotation first; its Jacobian is the inverse
right Jacobian of SE(3). The factor reads any number of poses, log-scales and intrinsics, so that its type is
made for each prior (:func:`marginalization_prior_type`).
Source: Sibley, Matthies and Sukhatme 2010, "Sliding window filter with application to planetary landing".
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray
from uni4d_fg.factors.factor_type import FactorType
from uni4d_fg.factors.variable import VariableType

MARGINALIZATION_PRIOR = "marginalization_prior"
"""Name of every such type."""


def marginalization_prior_type(variables: tuple[VariableType, ...]) -> FactorType:
    """Return the type of priors on the given variables, one slot each.

    Its data are ``root`` (N, n, n), ``offset`` (N, n) and the linearization points ``point_0``, ``point_1``, ...
    """
    names = tuple(f"point_{i}" for i in range(len(variables)))
    size = sum(variable.dim for variable in variables)

    def difference(values: tuple[Array, ...], data: dict[str, FloatArray]) -> FloatArray:
        parts = [
            variable.manifold.local(data[name], value)
            for variable, name, value in zip(variables, names, values, strict=True)
        ]
        return np.concatenate([np.zeros((len(data["offset"]), 0)), *parts], axis=1)

    def residual(*values: Array, **data: FloatArray) -> Array:
        d = difference(values, data)
        return np.einsum("nij,nj->ni", data["root"], d) + data["offset"]

    def linearize(*values: FloatArray, **data: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        d = difference(values, data)
        jacobians, start = [], 0
        for variable in variables:
            stop = start + variable.dim
            jacobians.append(data["root"][:, :, start:stop] @ variable.manifold.local_jacobian(d[:, start:stop]))
            start = stop
        return np.einsum("nij,nj->ni", data["root"], d) + data["offset"], jacobians

    shapes = {"root": (size, size), "offset": (size,)}
    shapes |= {name: variable.manifold.shape for name, variable in zip(names, variables, strict=True)}
    return FactorType(MARGINALIZATION_PRIOR, variables, shapes, size, residual, linearize, listed=False)
