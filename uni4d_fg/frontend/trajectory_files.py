"""Trajectory files: TUM (``timestamp tx ty tz qx qy qz qw``) and KITTI (the 12 numbers of a 3x4 pose).

Both hold camera-to-world poses. TUM quaternions are scalar-last. KITTI has no times: frames count from 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.files import atomic_path
from uni4d_fg.geometry.trajectory import Trajectory
from uni4d_fg.reading import read_text

TUM_FORMAT = "timestamp tx ty tz qx qy qz qw"
KITTI_FORMAT = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory; lines that start with ``#`` and empty lines are skipped.

    Raises:
        InputError: If the file is missing, a line does not hold 8 finite numbers, a quaternion is not of
            unit length (to 1 %), or timestamps decrease; the message names the line.
    """
    return read_tum_with(path, ())[0]


def read_tum_with(path: Path, columns: tuple[str, ...]) -> tuple[Trajectory, FloatArray | None]:
    """Read a TUM trajectory whose lines may all have some columns more.

    Args:
        path: The file.
        columns: Names of the further columns; positive numbers.

    Returns:
        The trajectory, and the further columns (T, len(columns)); None where the file does not have them.

    Raises:
        InputError: As :func:`read_tum`, and if some lines have the columns and others not, or one is not positive.
    """
    expected = f"TUM ({' '.join((TUM_FORMAT, *(f'[{name}]' for name in columns)))})"
    rows, lines = _read_rows(path, (8, 8 + len(columns)) if columns else (8,), expected)
    norms = np.linalg.norm(rows[:, 4:8], axis=1)
    skewed = np.flatnonzero(np.abs(norms - 1.0) > 1e-2)
    if len(skewed):
        raise InputError(
            f"{path}, line {lines[skewed[0]]}: quaternion of length {norms[skewed[0]]:.4g}, expected a unit "
            f"quaternion; the format is {expected}"
        )
    backwards = np.flatnonzero(np.diff(rows[:, 0]) < 0.0)
    if len(backwards):
        raise InputError(
            f"{path}, line {lines[backwards[0] + 1]}: timestamp is smaller than the one before it; sort the file"
        )
    flat = np.flatnonzero((rows[:, 8:] <= 0.0).any(axis=1))
    if len(flat):
        raise InputError(f"{path}, line {lines[flat[0]]}: {' and '.join(columns)} must be positive")
    world_T_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    world_T_cam[:, :3, :3] = Rotation.from_quat(rows[:, 4:8]).as_matrix()
    world_T_cam[:, :3, 3] = rows[:, 1:4]
    return Trajectory(rows[:, 0].copy(), world_T_cam), rows[:, 8:] if rows.shape[1] > 8 else None


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory, whole or not at all.

    Quaternions keep a continuous sign: each lies in the half-space of the one before it (the first has a
    non-negative scalar part), so that interpolating or plotting the columns needs no repair.

    Raises:
        OutputError: If the file cannot be written.
    """
    quaternions = continuous_quaternions(trajectory.world_T_cam[:, :3, :3])
    rows = np.concatenate((trajectory.timestamps[:, None], trajectory.world_T_cam[:, :3, 3], quaternions), axis=1)
    text = f"# {TUM_FORMAT}\n" + "".join(
        f"{row[0]:.9f} " + " ".join(f"{value:.12g}" for value in row[1:]) + "\n" for row in rows
    )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="ascii")


def continuous_quaternions(rotations: FloatArray) -> FloatArray:
    """Return scalar-last unit quaternions (T, 4) of rotations (T, 3, 3), without sign jumps."""
    quaternions: FloatArray = Rotation.from_matrix(rotations).as_quat(canonical=True)
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(flips)[:, None]
    return quaternions


def read_kitti(path: Path) -> Trajectory:
    """Read a KITTI odometry trajectory; the timestamps are the frame numbers.

    Rotations stay as written (KITTI rounds them to 7 digits), for scores that equal those of other programs.

    Raises:
        InputError: If the file is missing, a line does not hold 12 finite numbers, or its left 3x3 part is
            not a rotation (to 1e-2); the message names the line.
    """
    rows, lines = _read_rows(path, (12,), f"KITTI ({KITTI_FORMAT})")
    world_T_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    world_T_cam[:, :3] = rows.reshape(-1, 3, 4)
    rotation = world_T_cam[:, :3, :3]
    residual = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((residual > 1e-2) | (np.linalg.det(rotation) < 0.0))
    if len(bad):
        raise InputError(f"{path}, line {lines[bad[0]]}: not a rotation; the format is KITTI ({KITTI_FORMAT})")
    return Trajectory(np.arange(len(rows), dtype=np.float64), world_T_cam)


def write_kitti(path: Path, world_T_cam: FloatArray) -> None:
    """Write camera-to-world poses (T, 4, 4) as a KITTI odometry trajectory, whole or not at all.

    Raises:
        OutputError: If the file cannot be written.
    """
    rows = world_T_cam[:, :3].reshape(-1, 12).tolist()
    text = "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="ascii")


def _read_rows(path: Path, counts: tuple[int, ...], expected: str) -> tuple[FloatArray, list[int]]:
    """Return the numbers of a text file, the same count in every line, and each row's line number."""
    text = read_text(path, what=f"a trajectory of {expected}")
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        allowed = (len(rows[0]),) if rows else counts
        if len(fields) not in allowed:
            counted = " or ".join(str(count) for count in allowed)
            raise InputError(f"{path}, line {number}: {len(fields)} columns, expected {counted}: {expected}")
        try:
            values = [float(field) for field in fields]
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}; expected {expected}") from error
        if not np.isfinite(values).all():
            raise InputError(f"{path}, line {number}: a value is NaN or infinite; expected {expected}")
        rows.append(values)
        lines.append(number)
    if not rows:
        raise InputError(f"{path}: holds no pose; expected lines of {expected}")
    return np.array(rows, dtype=np.float64), lines
