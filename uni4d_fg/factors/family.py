"""The common shape of an energy term: a residual, its Jacobians, and the variables it reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from uni4d_fg.arrays import Array, FloatArray

ResidualFunction: TypeAlias = Callable[..., Array]
"""``residual(*variables, **data) -> (N, d)``; NumPy or torch, leading batch axis N."""

LinearizeFunction: TypeAlias = Callable[..., tuple[FloatArray, list[FloatArray]]]
"""``linearize(*variables, **data) -> r (N, d), [J_i (N, d, dim_i)]``; NumPy only.

Jacobians are with respect to each variable's tangent (see :mod:`uni4d_fg.graph.state`).
"""


@dataclass(frozen=True)
class FactorFamily:
    """One energy term as a function on arrays."""

    name: str
    """Name in summaries and error messages."""
    variables: tuple[str, ...]
    """Variable group read by each slot, in the order of the function's positional arguments."""
    data: tuple[str, ...]
    """Names of the per-row data arrays (keyword arguments)."""
    residual_dim: int
    """Length d of one residual."""
    residual: ResidualFunction
    linearize: LinearizeFunction
