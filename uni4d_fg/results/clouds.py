"""Colored point clouds as PLY files."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray, IntArray
from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import atomic_path
from uni4d_fg.optional import import_open3d
from uni4d_fg.reading import check_regular
from uni4d_fg.results.run_folder import RunFolder

_MAX_PLY_HEADER = 4096
_OWN_HEADER = re.compile(
    rb"ply\nformat binary_little_endian 1\.0\n(comment [^\n]*\n)*element vertex (?P<count>\d{1,12})\n"
    rb"property float x\nproperty float y\nproperty float z\n"
    rb"(?P<normals>property float nx\nproperty float ny\nproperty float nz\n)?"
    rb"property uchar red\nproperty uchar green\nproperty uchar blue\n"
)
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


def read_ply(path: Path, limit: int | None = None) -> tuple[FloatArray, ImageArray]:
    """Read a colored cloud: points (N, 3), meters, and RGB (N, 3).

    Args:
        path: The ``.ply`` file.
        limit: Most points read, from all over the file; the same every time.

    Raises:
        InputError: If the file is missing or no PLY.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    size = check_regular(path, "a PLY file")
    with open(path, "rb") as stream:
        head = stream.read(_MAX_PLY_HEADER)
    announced = re.search(rb"\nelement vertex (\d{1,20})\r?\n", head)
    if announced is not None and int(announced[1]) > size:
        raise InputError(f"{path}: announces {int(announced[1])} points in {size} bytes; make the clouds again")
    found = _read_own(path, head, size, limit) or _read_any(path, limit)
    if not np.isfinite(found[0]).all():
        raise InputError(f"{path}: has points or colors that are NaN or infinite; make the clouds again")
    return found


def _read_own(path: Path, head: bytes, size: int, limit: int | None = None) -> tuple[FloatArray, ImageArray] | None:
    """Read a file as :func:`write_ply` leaves it; None if it is any other. Loading Open3D takes longer than this."""
    text, ended, _ = head.partition(b"end_header\n")
    found = re.fullmatch(_OWN_HEADER, text)
    if not ended or found is None:
        return None
    names = ("x", "y", "z", *(("nx", "ny", "nz") if found["normals"] else ()))
    record = np.dtype([*((name, "<f4") for name in names), ("rgb", "u1", 3)])
    start, count = len(text) + len(ended), int(found["count"])
    if size != start + count * record.itemsize:
        return None
    if limit is None or count <= limit:
        rows = np.fromfile(path, record, count, offset=start)
    else:
        rows = np.memmap(path, record, "r", start, (count,))[_spread_rows(count, limit)]
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64), np.ascontiguousarray(rows["rgb"])


def _spread_rows(count: int, limit: int) -> IntArray:
    """Return ``limit`` rows of ``count``, ascending: one of each part, at random, so that no pattern of rows shows."""
    parts = np.arange(limit) + np.random.default_rng(0).random(limit)
    rows: IntArray = (parts * (count / limit)).astype(np.int64).clip(0, count - 1)
    return rows


def _read_any(path: Path, limit: int | None = None) -> tuple[FloatArray, ImageArray]:
    """Read a PLY of any program by Open3D; white where it has no colors. Raises InputError."""
    open3d = import_open3d()
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.io.read_point_cloud(str(path))
    points = np.asarray(cloud.points, dtype=np.float64).reshape(-1, 3)
    colors = np.asarray(cloud.colors, dtype=np.float64).reshape(-1, 3)
    if colors.shape != points.shape:
        colors = np.ones_like(points)
    if not np.isfinite(colors).all():
        raise InputError(f"{path}: has points or colors that are NaN or infinite; make the clouds again")
    if limit is not None and len(points) > limit:
        rows = _spread_rows(len(points), limit)
        points, colors = points[rows], colors[rows]
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
