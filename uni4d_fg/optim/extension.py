"""The optional C++ extension ``uni4d_fg_cpp``: loading it, and handing it batches."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Any

import numpy as np

from uni4d_fg import factors
from uni4d_fg.arrays import FloatArray
from uni4d_fg.errors import MissingDependencyError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State

REQUIRED_ABI = 15
"""Version of the extension's interface that this package speaks."""

INSTALL_COMMAND = "pip install ./cpp_factors"

KERNEL_CODES = {"quadratic": 0, "huber": 1, "pseudo_huber": 2, "cauchy": 3, "norm": 4}


@cache
def find_extension() -> tuple[Any, str]:
    """Return the extension's module and "", or None and the reason why it cannot be used."""
    try:
        package = importlib.import_module("uni4d_fg_cpp")
    except ModuleNotFoundError as error:
        if error.name == "uni4d_fg_cpp":
            return None, "the C++ extension uni4d-fg-cpp is not installed"
        return None, f"the C++ extension cannot be loaded ({error})"
    except (ImportError, OSError) as error:
        return None, f"the C++ extension cannot be loaded ({error})"
    abi = getattr(package, "ABI", None)
    if abi != REQUIRED_ABI:
        return None, f"the installed C++ extension has interface {abi}, this version of uni4d-fg needs {REQUIRED_ABI}"
    return package._core, ""


def import_extension() -> Any:
    """Return the extension's module.

    Raises:
        MissingDependencyError: If it is not installed, cannot be loaded or is of another version.
    """
    core, reason = find_extension()
    if core is None:
        raise MissingDependencyError(f"{reason}: run `{INSTALL_COMMAND}` in the source folder of uni4d-fg")
    return core


def linearize_batch(batch: FactorBatch, state: State) -> tuple[FloatArray, list[FloatArray]]:
    """Return what :meth:`FactorBatch.linearize` returns, computed by the extension where it has a kernel for it.

    Raises:
        SolverError: If a factor is not finite; names the variables.
    """
    name = _name(batch)
    if name is None:
        return batch.linearize(state)
    core = import_extension()
    try:
        r, jacobians = getattr(core, f"{name}_linearize")(*batch.gather(state), **_data(batch), threads=1)
        if np.isfinite(r.sum() + sum(jacobian.sum() for jacobian in jacobians)):
            white: FloatArray
            scaled: list[FloatArray]
            white, scaled = core.whiten(r, jacobians, **_noise(batch), threads=1)
            return white, scaled
    except ValueError:  # a value that is not finite: the batch itself names it
        pass
    return batch.linearize(state)


def batch_energy(batch: FactorBatch, state: State) -> float:
    """Return what :meth:`FactorBatch.energy` returns, computed by the extension where it has a kernel for it."""
    name = _name(batch)
    if name is None or len(batch) == 0:
        return batch.energy(state)
    core = import_extension()
    try:
        r = getattr(core, f"{name}_residual")(*batch.gather(state), **_data(batch), threads=1)
        return float(core.robust_energy(r, **_noise(batch), threads=1))
    except ValueError:
        return batch.energy(state)


def has_kernel(batch: FactorBatch) -> bool:
    """Return whether the extension has a kernel of the batch's factor type: of its name, data and dimensions.

    Raises:
        SolverError: If it has one for a type of this package that was declared elsewhere under the same name.
    """
    declared = batch.factor_type
    core, _ = find_extension()
    if core is None or not declared.listed or declared.name not in _kernels(core):
        return False
    kernel = _kernels(core)[declared.name]
    tangents = [kernel["tangents"][name] for name in kernel["variables"]]
    data = {name: tuple(kernel["shapes"][name]) for name in kernel["data"]}
    return (
        kernel["dim"] == declared.dim
        and tangents == [variable.dim for variable in declared.variables]
        and data == dict(declared.data)
    )


@cache
def _kernels(core: Any) -> dict[str, Any]:
    """Return what the extension declares of its kernels, by name.

    A kernel knows its type by name alone. With all types of this package declared, one of somebody's own that has the
    same name and data, but another residual, is an error instead of a wrong result.
    """
    for module in pkgutil.iter_modules(factors.__path__, f"{factors.__name__}."):
        importlib.import_module(module.name)
    return dict(core.factor_types())


def _name(batch: FactorBatch) -> str | None:
    return batch.factor_type.name if has_kernel(batch) else None


def _data(batch: FactorBatch) -> dict[str, FloatArray]:
    return {name: np.ascontiguousarray(array, dtype=np.float64) for name, array in batch.data.items()}


def _noise(batch: FactorBatch) -> dict[str, Any]:
    return {
        "sigma": np.ascontiguousarray(batch.sigma),
        "weight": np.ascontiguousarray(batch.weight),
        "kernel": KERNEL_CODES[batch.kernel.kind],
        "threshold": batch.kernel.threshold,
    }
