"""Camera poses and timestamps of a video."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.files import load_npy
from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of
from uni4d_fg.geometry.se3 import orthonormalize
from uni4d_fg.reading import read_text

MAX_ROTATION_ERROR = 1e-3
"""Largest entry of R R^T - I that is taken for rounding (and removed)."""


def load_poses(path: Path, num_frames: int, *, may_lack: bool = False) -> FloatArray:
    """Read camera-to-world poses.

    A bottom row of zeros, as some programs write, is repaired; rounding of the rotations is removed.

    Args:
        path: ``.npy`` file of (T, 4, 4), camera to world, OpenCV axes, meters.
        num_frames: T.
        may_lack: Take a frame of which the first three rows are all NaN or infinite for one whose pose is unknown.

    Returns:
        (T, 4, 4) rigid transforms; NaN where unknown.

    Raises:
        InputError: If the file cannot be read, has another shape, or holds anything but rigid transforms.
    """
    stored = load_npy(path, memory_map=True)
    if stored.shape != (num_frames, 4, 4):
        raise SequenceProblem(
            path, f"has shape {stored.shape} for {num_frames} frames", f"save poses as ({num_frames}, 4, 4)"
        )
    poses: FloatArray = np.array(stored, dtype=np.float64)
    finite = np.isfinite(poses)
    unknown = ~finite[:, :3].any(axis=(1, 2)) if may_lack else np.zeros(num_frames, dtype=bool)
    poses[unknown] = np.eye(4)
    bad = np.flatnonzero(~(finite.all(axis=(1, 2)) | unknown))
    if bad.size:
        raise SequenceProblem(
            path,
            f"has NaN or infinite entries in frame(s) {some_of(bad.tolist())}",
            "give every frame a pose",
        )
    zero_row = (poses[:, 3] == 0).all(axis=1)
    poses[zero_row, 3, 3] = 1.0
    bad = np.flatnonzero(np.abs(poses[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1) > 1e-6)
    if bad.size:
        raise SequenceProblem(
            path,
            f"has a bottom row other than 0 0 0 1 in frame(s) {some_of(bad.tolist())}",
            "save (4, 4) camera-to-world matrices, not transposed",
        )
    rotation = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
        proper = (error <= MAX_ROTATION_ERROR) & (np.linalg.det(rotation) > 0)
    bad = np.flatnonzero(~proper)
    if bad.size:
        raise SequenceProblem(
            path,
            f"has a rotation that is not orthonormal and right-handed in frame(s) {some_of(bad.tolist())}",
            "save rigid transforms without scale or mirroring",
        )
    rounded = error > 1e-12
    poses[rounded] = orthonormalize(poses[rounded])
    poses[:, 3] = (0.0, 0.0, 0.0, 1.0)
    poses[unknown] = np.nan
    return poses


def load_timestamps(path: Path, num_frames: int) -> FloatArray:
    """Read one timestamp per line, in seconds; blank lines and lines that start with # are skipped.

    Returns:
        (T,) seconds.

    Raises:
        InputError: If the file cannot be read, a line is not a number, the count differs from ``num_frames``,
            or the times do not increase strictly.
    """
    lines = read_text(path).splitlines()
    times: list[float] = []
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        try:
            times.append(float(text))
        except ValueError as error:
            raise SequenceProblem(
                path, f"line {number}: {text[:40]!r} is not a number", "write one number of seconds per line"
            ) from error
    if len(times) != num_frames:
        raise SequenceProblem(path, f"has {len(times)} timestamps for {num_frames} frames", "write one line per frame")
    timestamps = np.array(times)
    if not np.isfinite(timestamps).all():
        raise SequenceProblem(path, "has a NaN or infinite timestamp", "write one number of seconds per line")
    stuck = np.flatnonzero(np.diff(timestamps) <= 0)
    if stuck.size:
        raise SequenceProblem(
            path,
            f"does not increase after frame(s) {some_of(stuck.tolist())}",
            "sort the frames, or leave the file out",
        )
    return timestamps
