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
_PLAIN_BYTES, _NORMAL_BYTES = 3 * 4 + 3, 3 * 4
"""Of a point with its color, and of its normal."""


def write_ply(path: Path, points: FloatArray, colors: ImageArray, normals: FloatArray | None = None) -> None:
    """Write a colored cloud as binary PLY, whole or not at all; an empty cloud gives a file without points.

    Args:
        path: The ``.ply`` file.
        points: (N, 3) world positions, meters, finite.
        colors: (N, 3) RGB.
        normals: (N, 3) unit vectors in world axes, finite; none are written if None.

    Raises:
        OutputError: If the arrays are no cloud, or the file cannot be written.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    if points.ndim != 2 or points.shape[1:] != (3,) or colors.shape != points.shape:
        raise OutputError(f"{path}: points {points.shape} and colors {colors.shape} must both be (N, 3)")
    if not np.isfinite(points).all():
        raise OutputError(f"{path}: a point is NaN or infinite")
    if normals is not None and (normals.shape != points.shape or not np.isfinite(normals).all()):
        raise OutputError(f"{path}: normals {normals.shape} must be finite and as many as points {points.shape}")
    if len(points) == 0:
        _write_empty(path, with_normals=normals is not None)
        return
    open3d = import_open3d()
    cloud = open3d.t.geometry.PointCloud()
    cloud.point.positions = open3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
    cloud.point.colors = open3d.core.Tensor(np.ascontiguousarray(colors, dtype=np.uint8))
    if normals is not None:
        cloud.point.normals = open3d.core.Tensor(np.ascontiguousarray(normals, dtype=np.float32))
    size = len(points) * (_PLAIN_BYTES + (_NORMAL_BYTES if normals is not None else 0))
    quiet = open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error)
    with atomic_path(path) as temporary, quiet:
        if not open3d.t.io.write_point_cloud(str(temporary), cloud) or not _is_whole(temporary, size):
            raise OutputError(f"cannot write {path}: Open3D failed; check free space and the folder's permissions")


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
        MissingDependencyError: If Open3D cannot be loaded.
    """
    write_ply(folder.static_cloud, *static)
    count = 0
    for frame, cloud in enumerate(dynamic):
        write_ply(folder.dynamic_cloud(frame), *cloud)
        count += 1
    return count


def _is_whole(path: Path, size: int) -> bool:
    """Tell whether ``size`` bytes follow a PLY's header: Open3D does not notice a full disk."""
    content = path.read_bytes()
    header, found, _ = content.partition(b"end_header\n")
    return bool(found) and len(content) - len(header) - len(found) == size


def _write_empty(path: Path, *, with_normals: bool) -> None:
    axes = ("x", "y", "z", *(("nx", "ny", "nz") if with_normals else ()))
    coordinates = "".join(f"property float {axis}\n" for axis in axes)
    channels = "".join(f"property uchar {channel}\n" for channel in ("red", "green", "blue"))
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 0\n" + coordinates + channels + "end_header\n"
    with atomic_path(path) as temporary:
        temporary.write_text(header, encoding="ascii")
