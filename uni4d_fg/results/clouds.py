"""Colored point clouds as PLY files."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import atomic_path
from uni4d_fg.optional import import_open3d
from uni4d_fg.reading import check_regular
from uni4d_fg.results.run_folder import RunFolder

_MAX_PLY_HEADER = 4096
_AXES, _NORMAL, _CHANNELS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")


def write_ply(path: Path, points: FloatArray, colors: ImageArray, normals: FloatArray | None = None) -> None:
    """Write a colored cloud as binary PLY, whole or not at all; an empty cloud gives a file without points.

    Args:
        path: The ``.ply`` file.
        points: (N, 3) world positions, meters, finite.
        colors: (N, 3) RGB.
        normals: (N, 3) unit vectors in world axes, finite; none are written if None.

    Raises:
        OutputError: If the arrays are no cloud, or the file cannot be written.
    """
    if points.ndim != 2 or points.shape[1:] != (3,) or colors.shape != points.shape:
        raise OutputError(f"{path}: points {points.shape} and colors {colors.shape} must both be (N, 3)")
    if not np.isfinite(points).all():
        raise OutputError(f"{path}: a point is NaN or infinite")
    if normals is not None and (normals.shape != points.shape or not np.isfinite(normals).all()):
        raise OutputError(f"{path}: normals {normals.shape} must be finite and as many as points {points.shape}")
    numbers = _AXES if normals is None else _AXES + _NORMAL
    stored = np.empty(len(points), [*((name, "<f4") for name in numbers), *((name, "u1") for name in _CHANNELS)])
    columns = np.hstack([points, *(() if normals is None else (normals,)), colors])
    for column, name in enumerate(numbers + _CHANNELS):
        stored[name] = columns[:, column]
    properties = [f"property float {name}" for name in numbers] + [f"property uchar {name}" for name in _CHANNELS]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header"]
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        stream.write(("\n".join(header) + "\n").encode("ascii"))
        stream.write(stored.tobytes())


def read_ply(path: Path) -> tuple[FloatArray, ImageArray]:
    """Read a colored cloud: points (N, 3), meters, and RGB (N, 3).

    Raises:
        InputError: If the file is missing or no PLY.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    size = check_regular(path, "a PLY file")
    with open(path, "rb") as stream:
        announced = re.search(rb"\nelement vertex (\d{1,20})\r?\n", stream.read(_MAX_PLY_HEADER))
    if announced is not None and int(announced[1]) > size:
        raise InputError(f"{path}: announces {int(announced[1])} points in {size} bytes; make the clouds again")
    open3d = import_open3d()
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.io.read_point_cloud(str(path))
    points = np.asarray(cloud.points, dtype=np.float64).reshape(-1, 3)
    colors = np.asarray(cloud.colors, dtype=np.float64).reshape(-1, 3)
    if colors.shape != points.shape:
        colors = np.ones_like(points)
    if not (np.isfinite(points).all() and np.isfinite(colors).all()):
        raise InputError(f"{path}: has points or colors that are NaN or infinite; make the clouds again")
    return points, np.rint(np.clip(colors, 0.0, 1.0) * 255.0).astype(np.uint8)


def write_clouds(
    folder: RunFolder,
    static: tuple[FloatArray, ImageArray],
    dynamic: Iterable[tuple[FloatArray, ImageArray]],
) -> int:
    """Write the static cloud and one dynamic cloud per frame.

    Args:
        folder: The run's folder.
        static: Points (N, 3), meters, and RGB (N, 3).
        dynamic: The same for every frame in turn; may be a generator, one frame is held at a time.

    Returns:
        Number of dynamic clouds written.

    Raises:
        OutputError: If a file cannot be written.
    """
    write_ply(folder.static_cloud, *static)
    count = 0
    for frame, cloud in enumerate(dynamic):
        write_ply(folder.dynamic_cloud(frame), *cloud)
        count += 1
    return count
