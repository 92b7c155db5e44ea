"""Random arguments of any declared factor type, and its Jacobians by autograd and by differences."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping

import numpy as np
import torch

import uni4d_fg.factors
from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors import FactorType, VariableType, factor_types
from uni4d_fg.factors.variable import SE3, Manifold
from uni4d_fg.factors.variable_types import (
    DYNAMIC_POINT,
    FISHEYE_CAMERA,
    INTRINSICS,
    LANDMARK,
    OBJECT_POINT,
    OPENCV_CAMERA,
)

N = 6
SPREAD = 0.3
"""Standard deviation of values without a physical range."""

PHYSICAL: Mapping[VariableType, tuple[list[float], list[float]]] = {
    INTRINSICS: ([450, 450, 300, 200], [600, 600, 340, 260]),
    OPENCV_CAMERA: ([450, 450, 300, 200, -0.3, -0.1, -0.01, -0.01], [600, 600, 340, 260, 0.3, 0.1, 0.01, 0.01]),
    FISHEYE_CAMERA: ([150, 150, 300, 200, -0.1, -0.02, -0.01, -0.01], [250, 250, 340, 260, 0.1, 0.02, 0.01, 0.01]),
    LANDMARK: ([-1, -1, 2], [1, 1, 5]),
    DYNAMIC_POINT: ([-1, -1, 2], [1, 1, 5]),
    OBJECT_POINT: ([-1, -1, 2], [1, 1, 5]),
}
"""Ranges of the variables of which a residual makes sense in a range only: pixels, and points before the cameras."""

MEASURED: Mapping[str, Callable[[np.random.Generator, tuple[int, ...]], FloatArray]] = {
    "uv": lambda rng, shape: rng.uniform([0, 0], [640, 480], size=shape),
    "uv_source": lambda rng, shape: rng.uniform([0, 0], [640, 480], size=shape),
    "uv_target": lambda rng, shape: rng.uniform([0, 0], [640, 480], size=shape),
    "depth": lambda rng, shape: rng.uniform(1.0, 4.0, size=shape),
    "distance": lambda rng, shape: rng.uniform(1.0, 4.0, size=shape),
    "seconds_before": lambda rng, shape: rng.uniform(0.5, 2.0, size=shape),
    "seconds_after": lambda rng, shape: rng.uniform(0.5, 2.0, size=shape),
    "floor": lambda rng, shape: np.full(shape, 1e-3),
    "intrinsics": lambda rng, shape: rng.uniform(*PHYSICAL[INTRINSICS], size=shape),
}
"""The same of data, by name."""


def declared() -> list[FactorType]:
    """Return every type that a module of the package declares."""
    for module in pkgutil.iter_modules(uni4d_fg.factors.__path__, "uni4d_fg.factors."):
        importlib.import_module(module.name)
    return [t for t in factor_types() if t.residual.__module__.startswith("uni4d_fg.")]


def random_values(manifold: Manifold, rng: np.random.Generator, count: int = N) -> FloatArray:
    """Return values (count, \\*shape) of any manifold, from random parameters."""
    parameters = {
        name: rng.normal(scale=SPREAD, size=(count, columns.stop - columns.start))
        for name, columns in manifold.parameter_columns.items()
    }
    return np.asarray(manifold.from_parameters(parameters))


def random_variable(variable: VariableType, rng: np.random.Generator) -> FloatArray:
    if variable in PHYSICAL:
        return rng.uniform(*PHYSICAL[variable], size=(N, variable.dim))
    return random_values(variable.manifold, rng)


def random_data(name: str, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
    if name in MEASURED:
        return MEASURED[name](rng, (N, *shape))
    return random_values(SE3, rng) if shape == SE3.shape else rng.normal(scale=SPREAD, size=(N, *shape))


def random_case(factor_type: FactorType, seed: int) -> tuple[list[FloatArray], dict[str, FloatArray]]:
    rng = np.random.default_rng(seed)
    variables = [random_variable(variable, rng) for variable in factor_type.variables]
    return variables, {name: random_data(name, shape, rng) for name, shape in factor_type.data.items()}


def difference_jacobian(
    factor_type: FactorType,
    variables: list[FloatArray],
    data: dict[str, FloatArray],
    slot: int,
    step: float = 1e-6,
) -> FloatArray:
    """Differentiate by central differences along the variable's manifold."""
    variable = factor_type.variables[slot]
    columns = []
    for i in range(variable.dim):
        ends = []
        for sign in (1.0, -1.0):
            d = np.zeros((len(variables[slot]), variable.dim))
            d[:, i] = sign * step
            moved = list(variables)
            moved[slot] = variable.manifold.retract(variables[slot], d)
            ends.append(np.asarray(factor_type.residual(*moved, **data)))
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=2)


def torch_retract(manifold: Manifold, value: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
    """Retract in torch, on its own: a pose by the matrix exponential of its generators."""
    if manifold is not SE3:
        assert len(manifold.shape) == 1, f"write the retraction of {manifold.name} in torch"
        return value + tangent
    generators = torch.zeros(6, 4, 4, dtype=torch.float64)
    for i, (a, b) in enumerate([(2, 1), (0, 2), (1, 0)]):
        generators[i, a, b], generators[i, b, a] = 1.0, -1.0
        generators[3 + i, i, 3] = 1.0
    return value @ torch.linalg.matrix_exp(torch.einsum("ni,iab->nab", tangent, generators))


def autograd_jacobian(
    factor_type: FactorType, variables: list[FloatArray], data: dict[str, FloatArray], slot: int
) -> FloatArray:
    variable = factor_type.variables[slot]
    moved = [torch.from_numpy(v) for v in variables]
    step = torch.zeros(len(moved[slot]), variable.dim, dtype=torch.float64, requires_grad=True)
    moved[slot] = torch_retract(variable.manifold, moved[slot], step)
    r = factor_type.residual(*moved, **{name: torch.from_numpy(array) for name, array in data.items()})
    rows = []
    for i in range(r.shape[1]):
        if not r.requires_grad:
            return np.zeros((*r.shape, variable.dim))
        rows.append(torch.autograd.grad(r[:, i].sum(), step, retain_graph=True)[0])
    return torch.stack(rows, dim=1).numpy()
