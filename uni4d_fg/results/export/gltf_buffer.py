"""Arrays as the accessors of a glTF file (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, ImageArray

_COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u2"): 5123, np.dtype("<u4"): 5125}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class GltfBuffer:
    """One binary buffer that grows, and the views and accessors of a file that point into it.

    Args:
        library: The module ``pygltflib``.
        file: The ``GLTF2`` that gets them.
    """

    def __init__(self, library: Any, file: Any) -> None:
        self._library = library
        self._file = file
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, array: npt.NDArray[Any], *, bounds: bool = False, normalized: bool = False) -> int:
        """Append an array (N,) or (N, 2 to 4) of float32, uint16 or uint32; returns the number of its accessor.

        Args:
            array: The values.
            bounds: Say the least and largest values, as positions and times must.
            normalized: Integers stand for 0 to 1.
        """
        data = np.ascontiguousarray(array).tobytes()
        components = 1 if array.ndim == 1 else array.shape[1]
        view = self._library.BufferView(buffer=0, byteOffset=self._size, byteLength=len(data))
        self._file.bufferViews.append(view)
        extra: dict[str, Any] = {}
        if bounds:
            rows = array.reshape(len(array), components)
            extra = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        accessor = self._library.Accessor(
            bufferView=len(self._file.bufferViews) - 1, componentType=_COMPONENTS[array.dtype], count=len(array),
            type=_TYPES[components], normalized=normalized, **extra,
        )  # fmt: skip
        self._file.accessors.append(accessor)
        padding = -len(data) % 4
        self._parts += [data, b"\0" * padding]
        self._size += len(data) + padding
        return len(self._file.accessors) - 1

    def content(self) -> bytes:
        """Return the whole buffer."""
        return b"".join(self._parts)


def linear_colors(colors: ImageArray) -> npt.NDArray[np.uint16]:
    """Return sRGB (N, 3) as the linear, opaque 16-bit colors (N, 4) that glTF asks for."""
    steps = np.arange(256) / 255.0
    linear = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    table = np.rint(linear * 65535.0).astype("<u2")
    alpha = np.full((len(colors), 1), 65535, dtype="<u2")
    return np.concatenate((table[colors], alpha), axis=1)


def as_float32(array: npt.NDArray[Any]) -> Float32Array:
    """Return an array in little-endian single precision."""
    return np.ascontiguousarray(array, dtype="<f4")
