r"""GPS positions from a CSV file with a header.

Columns: ``timestamp`` [s] and either ``x, y, z`` [m] in axes of any map, or ``latitude, longitude`` [degrees] and
``altitude`` [m above the ellipsoid], which become east, north and up [m] about the first position used; optional
``sigma`` [m], or ``sigma_x, sigma_y, sigma_z``. Other columns are ignored, in any order.

    N = a / sqrt(1 - e^2 sin^2 phi)
    X = ((N + h) cos phi cos lambda, (N + h) cos phi sin lambda, (N (1 - e^2) + h) sin phi)

are the Earth-centered coordinates of latitude phi, longitude lambda and height h, on the ellipsoid a, e of WGS84; their
difference to the origin's is turned to the axes of its east, north and up.
Source: NGA.STND.0036, "World Geodetic System 1984"; Hofmann-Wellenhof et al. 2008, "GNSS", chapter 8.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.measurements import MeasurementsConfig
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.measurements.association import rows_of_frames
from uni4d_fg.reading import read_text

_AXIS_M = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_LOCAL = ("x", "y", "z")
_GEODETIC = ("latitude", "longitude", "altitude")
_SIGMAS = ("sigma_x", "sigma_y", "sigma_z")


@dataclass(frozen=True)
class GpsPositions:
    """Where the antenna was."""

    frame: IntArray
    """(M,) ascending."""
    xyz: FloatArray
    """(M, 3) m in the axes of the map."""
    sigma: FloatArray
    """(M, 3) m."""


def read_gps(path: Path, timestamps: FloatArray, config: MeasurementsConfig) -> tuple[GpsPositions, list[str]]:
    """Read the GPS positions of a sequence.

    Args:
        path: CSV file.
        timestamps: (T,) s of the frames.
        config: Sigma and tolerance.

    Returns:
        The positions, and warnings: how many belong to no frame.

    Raises:
        InputError: If the file cannot be read or fits no frame; the message names the line.
    """
    columns, lines = _read_columns(path)
    times = columns["timestamp"]
    backwards = np.flatnonzero(np.diff(times) < 0.0)
    if len(backwards):
        raise InputError(
            f"{path}, line {lines[backwards[0] + 1]}: timestamp is smaller than the one before it; sort the file"
        )
    geodetic = "latitude" in columns
    position = np.stack([columns[name] for name in (_GEODETIC if geodetic else _LOCAL)], axis=1)
    if geodetic:
        outside = np.flatnonzero((np.abs(position[:, 0]) > 90.0) | (np.abs(position[:, 1]) > 360.0))
        if len(outside):
            raise InputError(f"{path}, line {lines[outside[0]]}: latitude and longitude must be degrees")
    sigma = np.full((len(times), 3), config.gps_sigma_m)
    if "sigma" in columns:
        sigma = np.repeat(columns["sigma"][:, None], 3, axis=1)
    if "sigma_x" in columns:
        sigma = np.stack([columns[name] for name in _SIGMAS], axis=1)
    flat = np.flatnonzero((sigma <= 0.0).any(axis=1))
    if len(flat):
        raise InputError(f"{path}, line {lines[flat[0]]}: a sigma must be positive")
    row = rows_of_frames(path, times, timestamps, config.tolerance_s)
    frame = np.flatnonzero(row >= 0)
    used = row[frame]
    xyz = east_north_up(position[used], position[used[0]]) if geodetic else position[used]
    warnings = []
    if len(used) < len(times):
        warnings.append(
            f"{path.name}: {len(times) - len(used)} of {len(times)} positions belong to no frame (measurements."
            f"tolerance_s {config.tolerance_s:g}) and are left out"
        )
    return GpsPositions(frame, xyz, sigma[used]), warnings


def east_north_up(position: FloatArray, origin: FloatArray) -> FloatArray:
    """Return positions (N, 3) [degrees, degrees, m] in the axes of the origin (3,), (N, 3) m."""
    latitude, longitude = np.radians(origin[:2])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    axes = np.stack([east, np.cross(up, east), up])
    result: FloatArray = (earth_centered(position) - earth_centered(origin[None])) @ axes.T
    return result


def earth_centered(position: FloatArray) -> FloatArray:
    """Return latitude, longitude [degrees] and altitude [m] (N, 3) as Earth-centered, Earth-fixed (N, 3) m."""
    latitude, longitude = np.radians(position[:, 0]), np.radians(position[:, 1])
    squared = _FLATTENING * (2.0 - _FLATTENING)
    normal = _AXIS_M / np.sqrt(1.0 - squared * np.sin(latitude) ** 2)
    flat = (normal + position[:, 2]) * np.cos(latitude)
    height = (normal * (1.0 - squared) + position[:, 2]) * np.sin(latitude)
    return np.stack([flat * np.cos(longitude), flat * np.sin(longitude), height], axis=1)


def _read_columns(path: Path) -> tuple[dict[str, FloatArray], list[int]]:
    """Return the columns that count, (N,) each, and the line of each row."""
    expected = f"a header with timestamp and {','.join(_LOCAL)} or {','.join(_GEODETIC)}"
    try:
        text = read_text(path, what=f"a CSV file with {expected}").removeprefix("\ufeff")
        reader = csv.reader(text.splitlines(keepends=True))
        table = [(reader.line_num, fields) for fields in reader if fields and not fields[0].startswith("#")]
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as CSV ({error}); expected {expected}") from error
    if not table:
        raise InputError(f"{path}: is empty; expected {expected}")
    header = [name.strip().lower() for name in table[0][1]]
    names = _wanted(header)
    if names is None:
        raise InputError(f"{path}, line {table[0][0]}: has the columns {', '.join(header)[:200]}; expected {expected}")
    if len(table) == 1:
        raise InputError(f"{path}: has a header and no position")
    rows = []
    for line, fields in table[1:]:
        if len(fields) != len(header):
            raise InputError(f"{path}, line {line}: {len(fields)} columns, the header has {len(header)}")
        try:
            values = [float(fields[header.index(name)]) for name in names]
        except ValueError as error:
            raise InputError(f"{path}, line {line}: {error}; expected numbers") from error
        if not np.isfinite(values).all():
            raise InputError(f"{path}, line {line}: a value is NaN or infinite; leave such a row out")
        rows.append(values)
    array = np.array(rows)
    return {name: array[:, i] for i, name in enumerate(names)}, [line for line, _ in table[1:]]


def _wanted(header: list[str]) -> tuple[str, ...] | None:
    """Return the names of the columns that are read; None if one is missing."""
    position = _LOCAL if set(_LOCAL) <= set(header) else _GEODETIC
    if not {"timestamp", *position} <= set(header):
        return None
    if set(_SIGMAS) <= set(header):
        return ("timestamp", *position, *_SIGMAS)
    return ("timestamp", *position, "sigma") if "sigma" in header else ("timestamp", *position)
