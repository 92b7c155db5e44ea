"""The lists of the TUM RGB-D benchmark: times with file names, or with poses, and which belong together.

Lines are ``timestamp data ...``, separated by blanks, tabs or commas; ``#`` begins a comment
(https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats). Poses are ``timestamp tx ty tz qx qy qz qw``, camera
to world. Bonn's dynamic RGB-D dataset has the same files.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.reading import read_text

MAX_DIFFERENCE_S = 0.02
"""Farthest apart that two measurements belong together, as in the benchmark's ``associate.py``."""
CALIBRATION = "calibration.txt"
_AGAIN = "unpack the archive again"
_MAX_PAIRS = 10_000_000


@dataclass(frozen=True)
class FileList:
    """``rgb.txt`` or ``depth.txt``."""

    times: FloatArray
    """(N,) s, increasing."""
    paths: tuple[Path, ...]


@dataclass(frozen=True)
class PoseList:
    """``groundtruth.txt``."""

    times: FloatArray
    """(N,) s, increasing."""
    world_T_cam: FloatArray
    """(N, 4, 4) meters."""


def read_file_list(path: Path) -> FileList:
    """Read times and file names; names are relative to the list's folder. Raises InputError."""
    rows = _rows(path, 2)
    times = np.array([_number(path, line, words[0]) for line, words in rows])
    order = np.argsort(times, kind="stable")
    _check_times(path, times[order])
    return FileList(times[order], tuple(path.parent / rows[int(i)][1][1] for i in order))


def read_pose_list(path: Path) -> PoseList:
    """Read times and poses; rows without a pose (all of the quaternion 0, or NaN) are left out. Raises InputError."""
    rows = _rows(path, 8)
    values = np.array([[_number(path, line, word) for word in words[:8]] for line, words in rows])
    norms = np.linalg.norm(values[:, 4:], axis=1)
    known = np.isfinite(values).all(axis=1) & (norms > 0)
    skewed = np.flatnonzero(known & (np.abs(norms - 1.0) > 1e-2))
    if skewed.size:
        raise SequenceProblem(
            path, f"line {rows[int(skewed[0])][0]}: a quaternion of length {norms[skewed[0]]:.3g}", _AGAIN
        )
    values = values[known]
    if not len(values):
        raise SequenceProblem(path, "holds no pose", _AGAIN)
    order = np.argsort(values[:, 0], kind="stable")
    values = values[order]
    _check_times(path, values[:, 0])
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 4:]).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    return PoseList(values[:, 0].copy(), poses)


def intrinsics_of(folder: Path, published: tuple[float, float, float, float]) -> FloatArray:
    """Return (4,) fx, fy, cx, cy, px, of a video's color camera.

    The benchmarks publish them on their pages. A ``calibration.txt`` of these four numbers in the folder, which
    synthetic videos have, takes precedence.

    Raises:
        InputError: If that file is damaged.
    """
    path = folder / CALIBRATION
    if not path.is_file():
        return np.array(published)
    words = _rows(path, 4)[0]
    values = np.array([_number(path, words[0], word) for word in words[1][:4]])
    if not (np.isfinite(values).all() and (values[:2] > 0).all()):
        raise SequenceProblem(path, "does not hold fx, fy, cx, cy", _AGAIN)
    return values


def associate(
    first: FloatArray, second: FloatArray, max_difference_s: float = MAX_DIFFERENCE_S
) -> list[tuple[int, int]]:
    """Pair times with each other, nearest pairs first, each time at most once.

    Args:
        first: (N,) s.
        second: (M,) s.
        max_difference_s: Pairs must be closer than this.

    Returns:
        (index of first, index of second), by the former. What ``associate.py`` of the benchmark finds.

    Raises:
        InputError: If far more times are near each other than those of a camera can be.
    """
    pairs: list[tuple[float, int, int]] = []
    order = np.argsort(second, kind="stable")
    low = np.searchsorted(second[order], first - max_difference_s, side="left")
    high = np.searchsorted(second[order], first + max_difference_s, side="right")
    if int((high - low).sum()) > _MAX_PAIRS:
        raise InputError(
            f"the lists have {len(first)} and {len(second)} times, most of them closer than {max_difference_s:g} s to "
            "many others; no camera is that fast: check rgb.txt, depth.txt and groundtruth.txt"
        )
    for i in range(len(first)):
        for j in order[low[i] : high[i]]:
            distance = abs(float(first[i]) - float(second[j]))
            if distance < max_difference_s:
                pairs.append((distance, i, int(j)))
    left, right = set(range(len(first))), set(range(len(second)))
    found = []
    for _, i, j in sorted(pairs):
        if i in left and j in right:
            left.remove(i)
            right.remove(j)
            found.append((i, j))
    return sorted(found)


def _rows(path: Path, columns: int) -> list[tuple[int, list[str]]]:
    """Return (line number, words) of the lines that hold something."""
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < columns:
            raise SequenceProblem(path, f"line {number}: {len(words)} column(s), expected {columns}", _AGAIN)
        rows.append((number, words))
    if not rows:
        raise SequenceProblem(path, "holds no line", _AGAIN)
    return rows


def _number(path: Path, line: int, word: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise SequenceProblem(path, f"line {line}: {word[:40]!r} is not a number", _AGAIN) from error


def _check_times(path: Path, times: FloatArray) -> None:
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise SequenceProblem(path, "has a time twice, or one that is no number", _AGAIN)
