"""MPI-Sintel's own files: ``.dpt`` depth and ``.cam`` cameras.

The layout is that of ``sintel_io.py``, which comes with the depth archive (J. Wulff, 2015): little-endian, beginning
with the float32 202021.25 (the bytes ``PIEH``); then for ``.dpt`` width and height as int32 and float32 depths row by
row, and for ``.cam`` the intrinsics, 9 float64, and the extrinsics, 12 float64 of a 3 x 4 matrix, world to camera.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.files import atomic_path
from uni4d_fg.frontend.sequence.decode import MAX_PIXELS, clean_depth
from uni4d_fg.frontend.sequence.frames import FileFrames
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.geometry.se3 import inverse, orthonormalize
from uni4d_fg.reading import MAX_IMAGE_BYTES, read_bytes

TAG = b"PIEH"
_AGAIN = "unpack the archive again"
_CAMERA_BYTES = 4 + 8 * (9 + 12)


class DptDepth(FileFrames[Float32Array]):
    """T ``.dpt`` files as (H, W) float32 meters."""

    def _decode(self, path: Path) -> Float32Array:
        return read_dpt(path)


def read_dpt(path: Path) -> Float32Array:
    """Read depth (H, W), float32 meters; values that are no depth become NaN. Raises InputError."""
    data = _tagged(path, ".dpt")
    if len(data) < 12:
        raise SequenceProblem(path, f"is cut short ({len(data)} bytes)", _AGAIN)
    width, height = struct.unpack("<ii", data[4:12])
    if width <= 0 or height <= 0 or width * height > MAX_PIXELS:
        raise SequenceProblem(path, f"announces {width} x {height} px", _AGAIN)
    if len(data) != 12 + 4 * width * height:
        raise SequenceProblem(
            path, f"has {len(data)} bytes, but {width} x {height} px take {12 + 4 * width * height}", _AGAIN
        )
    return clean_depth(np.frombuffer(data, "<f4", offset=12).reshape(height, width))


def write_dpt(path: Path, depth: Float32Array) -> None:
    """Write depth (H, W), meters. Raises OutputError."""
    height, width = depth.shape
    with atomic_path(path) as temporary:
        temporary.write_bytes(TAG + struct.pack("<ii", width, height) + depth.astype("<f4").tobytes())


def read_cam(path: Path) -> tuple[FloatArray, FloatArray]:
    """Read a camera.

    Returns:
        (3, 3) intrinsics, px, and (4, 4) camera to world, OpenCV axes, meters.

    Raises:
        InputError: If the file is damaged or the matrices are not those of a pinhole camera.
    """
    data = _tagged(path, ".cam")
    if len(data) != _CAMERA_BYTES:
        raise SequenceProblem(path, f"has {len(data)} bytes, not {_CAMERA_BYTES}", _AGAIN)
    values = np.frombuffer(data, "<f8", offset=4)
    matrix, cam_T_world = values[:9].reshape(3, 3).astype(np.float64), np.eye(4)
    cam_T_world[:3] = values[9:].reshape(3, 4)
    if not np.isfinite(values).all():
        raise SequenceProblem(path, "has a value that is NaN or infinite", _AGAIN)
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.allclose(matrix[2], (0, 0, 1))):
        raise SequenceProblem(path, "does not hold the intrinsics of a pinhole camera", _AGAIN)
    rotation = cam_T_world[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise SequenceProblem(path, "has a rotation that is not orthonormal and right-handed", _AGAIN)
    return matrix, inverse(orthonormalize(cam_T_world))


def write_cam(path: Path, matrix: FloatArray, world_T_cam: FloatArray) -> None:
    """Write a camera: (3, 3) intrinsics, px, and (4, 4) camera to world, meters. Raises OutputError."""
    extrinsics = inverse(world_T_cam)[:3]
    with atomic_path(path) as temporary:
        temporary.write_bytes(TAG + matrix.astype("<f8").tobytes() + extrinsics.astype("<f8").tobytes())


def _tagged(path: Path, what: str) -> bytes:
    data = read_bytes(path, MAX_IMAGE_BYTES, f"a {what} file")
    if data[:4] != TAG:
        raise SequenceProblem(path, f"is not a {what} file: it does not begin with {TAG.decode()}", _AGAIN)
    return data
