"""GTSAM's own factors inside a problem of ours.

Native factors that read variables of the same types are one batch: its residual and its linearization ask GTSAM. So
they are factors like any other for every solver, the fast ones included. What a batch of N costs is one ``Values`` of
the variables that it touches and N calls of ``linearize``, however large the rest of the problem is.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import Array, FloatArray, IntArray
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.factor_type import FactorType, NativeRow
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType, describe


def native_batches(factors: Iterable[Any], state: State) -> list[FactorBatch]:
    """Return factors of GTSAM's as batches, one per class of factor, variable types and dimension.

    Args:
        factors: ``gtsam.NonlinearFactor`` objects: native ones, or a user's ``gtsam.CustomFactor``.
        state: Has every variable that the factors read.

    Raises:
        SolverError: If a factor reads a key that the state does not have.
    """
    groups: dict[tuple[Any, ...], list[tuple[Any, list[int]]]] = {}
    for item in factors:
        keys = list(item.keys())
        try:
            found = state.rows_of(keys)
        except KeyError as error:
            raise SolverError(
                f"{type(item).__name__} reads {describe(int(error.args[0]))}, which the problem does not have"
            ) from None
        kinds = tuple(variable for variable, _ in found)
        groups.setdefault((type(item).__name__, kinds, int(item.dim())), []).append((item, [row for _, row in found]))
    batches = []
    for (name, kinds, dim), members in groups.items():
        rows = np.array([rows for _, rows in members], dtype=np.int64)
        batches.append(_native_batch(name, kinds, dim, [item for item, _ in members], rows))
    return batches


def _native_batch(
    name: str, variables: tuple[VariableType, ...], dim: int, factors: list[Any], rows: IntArray
) -> FactorBatch:
    """Return one batch; its datum ``number`` (N,) tells which of the factors a row is."""
    keys = [list(item.keys()) for item in factors]
    # Half the square of a Gaussian's whitened error is its energy: no kernel comes between.
    gaussian_noise = [_is_gaussian(item) for item in factors]

    def values_of(arguments: tuple[FloatArray, ...], number: IntArray) -> gtsam.Values:
        values, seen = gtsam.Values(), set[int]()
        for slot, (variable, array) in enumerate(zip(variables, arguments, strict=True)):
            if not isinstance(array, np.ndarray):
                raise SolverError(f"{name} is a factor of GTSAM's, which Adam cannot differentiate; use solver 'lm'")
            for row, n in enumerate(number.tolist()):
                key = keys[n][slot]
                if key not in seen:
                    seen.add(key)
                    values.insert(key, variable.to_gtsam(array[row]))
        return values

    def residual(*arguments: Array, number: Array) -> Array:
        """Return the whitened errors, scaled so that half their square is GTSAM's error, kernels included."""
        number = np.asarray(number, dtype=np.int64)
        values = values_of(arguments, number)
        out = np.zeros((len(number), dim))
        for row, n in enumerate(number.tolist()):
            item = factors[n]
            error = np.asarray(item.whitenedError(values)) if hasattr(item, "whitenedError") else np.ones(dim)
            if gaussian_noise[n]:
                out[row] = error
                continue
            size = np.sqrt(2.0 * item.error(values))
            norm = float(np.linalg.norm(error))
            out[row] = error * (size / norm) if norm > 0.0 else 0.0
        return out

    def linearize(*arguments: FloatArray, number: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        chosen = np.asarray(number, dtype=np.int64)
        values = values_of(arguments, chosen)
        r = np.zeros((len(chosen), dim))
        jacobians = [np.zeros((len(chosen), dim, variable.dim)) for variable in variables]
        for row, n in enumerate(chosen.tolist()):
            gaussian = factors[n].linearize(values)
            if gaussian is None:  # the factor is not active here
                continue
            matrix, right = gaussian.jacobian()
            count, start = len(right), 0
            if count > dim:
                raise SolverError(f"{name} linearizes to {count} rows where its dimension is {dim}")
            r[row, :count] = -right
            for slot, variable in enumerate(variables):
                width = variable.gtsam_dim or variable.dim
                block = matrix[:, start : start + width]
                columns = list(variable.gtsam_columns) if variable.gtsam_columns else slice(None)
                jacobians[slot][row, :count] = block[:, columns]
                start += width
        return r, jacobians

    def native(row: NativeRow) -> Any:
        return factors[int(row.data["number"])]

    factor_type = FactorType(name, variables, {"number": ()}, dim, residual, linearize, native=native, listed=False)
    slots = tuple(Slot(variable, rows[:, i]) for i, variable in enumerate(variables))
    return FactorBatch.create(factor_type, slots, {"number": np.arange(len(factors), dtype=np.float64)})


def _is_gaussian(item: Any) -> bool:
    """Return whether a factor's noise is Gaussian without a robust kernel, and its whitened error is to be had."""
    noise = item.noiseModel() if hasattr(item, "noiseModel") and hasattr(item, "whitenedError") else None
    return isinstance(noise, gtsam.noiseModel.Gaussian)
