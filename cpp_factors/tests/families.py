"""Every factor type that has a C++ kernel, as the extension itself lists them: random arguments, and its NumPy twin."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

import numpy as np
from uni4d_fg_cpp import _core

from uni4d_fg import factors
from uni4d_fg.factors import FactorType, factor_types
from uni4d_fg.geometry import se3

Arguments = dict[str, np.ndarray]

TYPES: dict[str, dict[str, Any]] = _core.factor_types()

for _module in pkgutil.iter_modules(factors.__path__):
    importlib.import_module(f"{factors.__name__}.{_module.name}")

TWINS: dict[str, FactorType] = {
    kind.name: kind
    for kind in factor_types()
    if kind.name in TYPES and kind.residual.__module__.startswith(f"{factors.__name__}.")
}
"""The types of the Python package that have a kernel, by name; other tests of one session may declare more."""


def arguments_of(name: str, rng: np.random.Generator, count: int) -> Arguments:
    """Return every argument of a type by name, variables first; by its shape, and by its name where that says more."""

    def intrinsics() -> np.ndarray:
        return rng.uniform(200, 900, (count, 4))

    def poses() -> np.ndarray:
        return se3.se3_exp(rng.normal(size=(count, 6)) * np.array([0.4, 0.4, 0.4, 1.0, 1.0, 1.0]))

    def cameras() -> np.ndarray:
        return np.concatenate([intrinsics(), rng.normal(size=(count, 4)) * 0.1], axis=1)

    by_name = {"camera": cameras, "floor": lambda: rng.uniform(1e-4, 1e-2, count), "intrinsics": intrinsics}
    by_shape = {
        (4, 4): poses,
        (3,): lambda: rng.normal(size=(count, 3)) * 2.0 + np.array([0.0, 0.0, 3.0]),
        (2,): lambda: rng.uniform(0, 600, (count, 2)),
    }
    kind, out = TYPES[name], {}
    for argument in (*kind["variables"], *kind["data"]):
        shape = kind["shapes"][argument]
        make = by_name.get(argument) or by_shape.get(shape)
        if make is not None:
            out[argument] = make()
        elif argument in kind["positive"]:
            out[argument] = rng.uniform(0.3, 9, (count, *shape))
        else:
            out[argument] = rng.normal(size=(count, *shape))
    return out


def split_arguments(name: str, arguments: Arguments) -> tuple[list[np.ndarray], Arguments]:
    """Return the variables in order and the data by name."""
    kind = TYPES[name]
    return [arguments[n] for n in kind["variables"]], {n: arguments[n] for n in kind["data"]}


def retract(values: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """Move the rows of a variable by tangents (N, dim): T Exp(xi) for poses, a sum for all else."""
    return values @ se3.se3_exp(delta) if values.ndim == 3 else values + delta
