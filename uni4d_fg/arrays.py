"""Array types, the namespace switch that lets one residual serve NumPy and torch, spread indices, sums by row."""

from __future__ import annotations

from typing import Any, TypeAlias, TypeVar

import array_api_compat
import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
Float32Array: TypeAlias = npt.NDArray[np.float32]
IntArray: TypeAlias = npt.NDArray[np.int64]
Int32Array: TypeAlias = npt.NDArray[np.int32]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
ImageArray: TypeAlias = npt.NDArray[np.uint8]

ScalarT = TypeVar("ScalarT", bound=np.generic)

# Residual functions accept either numpy.ndarray or torch.Tensor; neither is a subtype of the other.
Array: TypeAlias = Any


def namespace(array: Array) -> Any:
    """Return the array-API namespace (NumPy or torch) that ``array`` belongs to."""
    return array_api_compat.array_namespace(array)


def evenly_spread(count: int, limit: int) -> IntArray:
    """Return up to ``limit`` of the indices 0 .. count - 1, evenly spread, ascending, first and last among them."""
    return np.linspace(0, count - 1, min(count, limit)).astype(np.int64)


def at_nearest_pixel(values: npt.NDArray[ScalarT], uv: npt.NDArray[np.floating]) -> npt.NDArray[ScalarT]:
    """Return what a map (H, W) has at the pixel nearest to each position (N, 2) px; outside of it, at its border."""
    column, row = np.clip(np.rint(uv), 0, (values.shape[1] - 1, values.shape[0] - 1)).astype(np.int64).T
    found: npt.NDArray[ScalarT] = values[row, column]
    return found


def rows_by_group(group: npt.NDArray[np.integer], count: int) -> list[IntArray]:
    """Return the rows, ascending, of each of the groups 0 .. count - 1 of values (N,)."""
    order = np.argsort(group, kind="stable")
    return np.split(order, np.cumsum(np.bincount(group, minlength=count)[: count - 1]))


def sum_rows(values: FloatArray, row: IntArray, count: int) -> FloatArray:
    """Return the sums (count, ...) of the values (N, ...) of each row (N,); 0 for a row without any."""
    columns = int(np.prod(values.shape[1:]))
    flat, out = values.reshape(len(values), columns), np.zeros((count, columns))
    for column in range(columns):
        out[:, column] = np.bincount(row, flat[:, column], count)
    return out.reshape(count, *values.shape[1:])
