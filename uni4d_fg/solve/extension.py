"""The optional C++ extension ``uni4d_fg_cpp``: loading it, and handing it batches."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.errors import MissingDependencyError
from uni4d_fg.factors.arap import ARAP
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.camera_motion import CAMERA_ROTATION, CAMERA_TRANSLATION
from uni4d_fg.factors.depth_prior import DYNAMIC_DEPTH_PRIOR, STATIC_DEPTH_PRIOR
from uni4d_fg.factors.depth_reprojection import DEPTH_REPROJECTION
from uni4d_fg.factors.dynamic_reprojection import DYNAMIC_REPROJECTION
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.factors.temporal_smoothness import ACCELERATION_SMOOTHNESS, VELOCITY_SMOOTHNESS
from uni4d_fg.graph.state import State

REQUIRED_ABI = 1
"""Version of the extension's interface that this package speaks."""

INSTALL_COMMAND = "pip install ./cpp_factors"

KERNEL_CODES = {"quadratic": 0, "huber": 1, "pseudo_huber": 2, "cauchy": 3, "norm": 4}

_FAMILIES = (
    (DEPTH_REPROJECTION, "depth_reprojection"),
    (STATIC_REPROJECTION, "static_reprojection"),
    (DYNAMIC_REPROJECTION, "dynamic_reprojection"),
    (CAMERA_ROTATION, "camera_rotation"),
    (CAMERA_TRANSLATION, "camera_translation"),
    (ARAP, "arap"),
    (VELOCITY_SMOOTHNESS, "velocity_smoothness"),
    (ACCELERATION_SMOOTHNESS, "acceleration_smoothness"),
    (STATIC_DEPTH_PRIOR, "static_depth_prior"),
    (DYNAMIC_DEPTH_PRIOR, "dynamic_depth_prior"),
)


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
    """Return what :meth:`FactorBatch.linearize` returns, computed by the extension where it knows the family.

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
    """Return what :meth:`FactorBatch.energy` returns, computed by the extension where it knows the family."""
    name = _name(batch)
    if name is None or len(batch) == 0:
        return batch.energy(state)
    core = import_extension()
    try:
        r = getattr(core, f"{name}_residual")(*batch.gather(state), **_data(batch), threads=1)
        return float(core.robust_energy(r, **_noise(batch), threads=1))
    except ValueError:
        return batch.energy(state)


def _name(batch: FactorBatch) -> str | None:
    return next((name for family, name in _FAMILIES if family is batch.family), None)


def _data(batch: FactorBatch) -> dict[str, FloatArray]:
    return {name: np.ascontiguousarray(array, dtype=np.float64) for name, array in batch.data.items()}


def _noise(batch: FactorBatch) -> dict[str, Any]:
    return {
        "sigma": np.ascontiguousarray(batch.sigma),
        "weight": np.ascontiguousarray(batch.weight),
        "kernel": KERNEL_CODES[batch.kernel.kind],
        "threshold": batch.kernel.threshold,
    }
