r"""Relative poses of cameras from a g2o file: ``EDGE_SE3:QUAT i j x y z qx qy qz qw I11 I12 ... I66``.

An edge says that camera j stands at (x, y, z), q in the axes of camera i; i and j are frame numbers. The 21 numbers
are the upper triangle of the information matrix, row by row, of (translation, rotation); ours is of the twist
(rotation, translation), so that the blocks change places. The rotation's part is taken as that of the rotation vector
[1/rad^2], as ``gtsam.readG2o`` does. Vertices and other lines are skipped: the frames have estimates of their own.
Source: Kuemmerle et al. 2011, "g2o: a general framework for graph optimization".
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.errors import InputError
from uni4d_fg.reading import read_text

EDGE_FORMAT = "EDGE_SE3:QUAT i j x y z qx qy qz qw and the 21 numbers of the information's upper triangle"
_TAG = "EDGE_SE3:QUAT"
_COUNT = 2 + 7 + 21
_ORDER = [3, 4, 5, 0, 1, 2]


@dataclass(frozen=True)
class RelativePoses:
    """Known poses of some cameras in the axes of others."""

    first: IntArray
    """(M,) frame."""
    second: IntArray
    """(M,) frame."""
    first_T_second: FloatArray
    """(M, 4, 4) m."""
    information: FloatArray
    """(M, 6, 6) of the twist (rotation [rad], translation [m])."""


def read_relative_poses(path: Path, num_frames: int) -> tuple[RelativePoses, list[str]]:
    """Read the edges of a g2o file between the frames of a sequence.

    Args:
        path: g2o file.
        num_frames: T; edges with a number outside of 0 .. T - 1 are left out.

    Returns:
        The edges, and warnings: how many were left out.

    Raises:
        InputError: If the file cannot be read, an edge is malformed, or none is between two frames; the message names
            the line.
    """
    text = read_text(path, what=f"a g2o file with lines of {EDGE_FORMAT}")
    edges, other = [], 0
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if fields and fields[0] == _TAG:
            edge = _edge(fields[1:], f"{path}, line {number}")
            if max(edge[0], edge[1]) < num_frames:
                edges.append(edge)
            else:
                other += 1
    if not edges:
        if other:
            raise InputError(f"{path}: all {other} edges are of frames that the sequence does not have; its frames are "
                             f"numbered 0 to {num_frames - 1}")  # fmt: skip
        raise InputError(f"{path}: has no {_TAG}; expected lines of {EDGE_FORMAT}")
    warnings = []
    if other:
        warnings.append(f"{path.name}: {other} of {other + len(edges)} edges are of frames that the sequence does not "
                        f"have (0 to {num_frames - 1}) and are left out")  # fmt: skip
    first, second, poses, information = zip(*edges, strict=True)
    return RelativePoses(np.array(first), np.array(second), np.stack(poses), np.stack(information)), warnings


def _edge(fields: list[str], where: str) -> tuple[int, int, FloatArray, FloatArray]:
    if len(fields) != _COUNT:
        raise InputError(f"{where}: {len(fields)} numbers after {_TAG}, expected {_COUNT}: {EDGE_FORMAT}")
    try:
        first, second = int(fields[0]), int(fields[1])
        values = np.array([float(field) for field in fields[2:]])
    except ValueError as error:
        raise InputError(f"{where}: {error}; expected {EDGE_FORMAT}") from error
    if not np.isfinite(values).all():
        raise InputError(f"{where}: a value is NaN or infinite")
    if first < 0 or second < 0 or first == second:
        raise InputError(f"{where}: {first} and {second} are not two frames")
    length = float(np.linalg.norm(values[3:7]))
    if abs(length - 1.0) > 1e-2:
        raise InputError(f"{where}: quaternion of length {length:.4g}, expected a unit quaternion")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[3:7]).as_matrix(), values[:3]
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = values[7:]
    information = (upper + upper.T - np.diag(np.diag(upper)))[np.ix_(_ORDER, _ORDER)]
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        raise InputError(f"{where}: the information matrix is not positive definite")
    return first, second, pose, information
