"""Maps of floating-point numbers in a fifth of their size, rounded far below what cues are good for.

The last bits of a number are noise, which does not compress, and neighbors hardly differ. So numbers are rounded to
their first 12 bits (11 of them stored), the bit patterns of neighbors in a row are subtracted, and the bytes of the
differences are compressed each kind for itself.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz, save_npz

RELATIVE_ERROR = 2.0**-12
"""By how much a number may change; 2.4e-4."""
_DROPPED_BITS = np.uint32(12)
_NUM_BYTES = 3


def save_map(path: Path, values: Float32Array) -> None:
    """Write a map (H, W), float32, rounded by up to :data:`RELATIVE_ERROR`, whole or not at all (``.npz``).

    Infinite and missing (NaN) values stay what they are.

    Raises:
        OutputError: If it cannot be written.
    """
    save_npz(path, planes=_packed(np.asarray(values, np.float32)))


def load_map(path: Path) -> Float32Array:
    """Read what :func:`save_map` wrote, (H, W); the file's own checksums tell whether it is whole.

    Raises:
        InputError: If it is missing, damaged, or none.
    """
    planes = load_npz(path, {"planes": 3})["planes"]
    if planes.dtype != np.uint8 or len(planes) != _NUM_BYTES:
        raise InputError(f"{path}: is not a map of the cue cache; remove it and start again")
    return _unpacked(planes)


def rounded(values: Float32Array) -> Float32Array:
    """Return values as they come back from a file."""
    return _unpacked(_packed(np.asarray(values, np.float32)))


def _packed(values: Float32Array) -> ImageArray:
    """Return the bytes (3, H, W) of the differences along rows."""
    # Every NaN in one pattern: adding to that of some would give a number.
    bits = np.where(np.isnan(values), np.float32(np.nan), values).view(np.uint32)
    limit = np.uint32(0x7F7FF000) | (bits & np.uint32(0x80000000))
    half = np.uint32(1) << (_DROPPED_BITS - np.uint32(1))
    # A number that would be rounded to infinity is the largest that is not.
    up = np.where(np.isfinite(values), np.minimum(bits + half, limit), bits)
    kept = up >> _DROPPED_BITS
    differences = np.diff(kept, axis=1, prepend=np.uint32(0))
    return np.stack([(differences >> np.uint32(8 * byte)).astype(np.uint8) for byte in range(_NUM_BYTES)])


def _unpacked(planes: ImageArray) -> Float32Array:
    differences = np.zeros(planes.shape[1:], np.uint32)
    for byte in range(_NUM_BYTES):
        differences |= planes[byte].astype(np.uint32) << np.uint32(8 * byte)
    kept = np.cumsum(differences, axis=1, dtype=np.uint32)
    # Bits above the differences' own are those of borrowing, and are shifted out.
    values: Float32Array = (kept << _DROPPED_BITS).view(np.float32)
    return values
