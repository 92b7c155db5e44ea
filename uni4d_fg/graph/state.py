"""The values of all variables, as one array per group, and their retraction.

| group | array | tangent |
|---|---|---|
| pose | (T, 4, 4) ``world_T_cam`` | 6: body-frame (omega [rad], v [m]), ``T Exp(xi)`` |
| intrinsics | (C, 4) fx, fy, cx, cy, px | 4 |
| log_scale | (T, 1) | 1 |
| landmark | (N, 3) world, m | 3 |
| dynamic_point | (P, 3) world, m; row i is (track, frame) = ``names[i]`` | 3 |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.geometry import se3
from uni4d_fg.graph import keys

TANGENT_DIM = {"pose": 6, "intrinsics": 4, "log_scale": 1, "landmark": 3, "dynamic_point": 3}

Delta = Mapping[str, FloatArray]
"""Tangent step per group: (n, dim)."""


@dataclass(frozen=True)
class VariableNames:
    """What each row of a group is called: the arguments of its key."""

    landmark_track: IntArray | None = None
    """(N,) track of each landmark row; the row number when None."""
    dynamic_track_frame: IntArray | None = None
    """(P, 2) track and frame of each dynamic point row."""


@dataclass(frozen=True)
class State:
    """Values of every variable of a problem. Immutable: :meth:`retract` returns a new state."""

    groups: Mapping[str, FloatArray]
    names: VariableNames = field(default_factory=VariableNames)

    def __getitem__(self, group: str) -> FloatArray:
        return self.groups[group]

    def replace(self, **groups: FloatArray) -> State:
        """Return a state in which the given groups have new values."""
        return State({**self.groups, **groups}, self.names)

    def retract(self, delta: Delta) -> State:
        """Move every group along its tangent step; groups without one stay as they are (not copied)."""
        moved = dict(self.groups)
        for group, step in delta.items():
            if group == "pose":
                moved[group] = se3.retract(self.groups[group], step)
            else:
                moved[group] = self.groups[group] + step
        return State(moved, self.names)

    def key(self, group: str, row: int) -> int:
        """Return the GTSAM key of one row of a group."""
        if group == "landmark":
            track = self.names.landmark_track
            return keys.landmark_key(row if track is None else int(track[row]))
        if group == "dynamic_point":
            if self.names.dynamic_track_frame is None:
                return keys.dynamic_point_key(row, 0)
            track_frame = self.names.dynamic_track_frame[row]
            return keys.dynamic_point_key(int(track_frame[0]), int(track_frame[1]))
        make: dict[str, Callable[[int], int]] = {
            "pose": keys.pose_key,
            "intrinsics": keys.intrinsics_key,
            "log_scale": keys.log_scale_key,
        }
        return make[group](row)

    def to_values(self, free: Mapping[str, BoolArray] | None = None) -> gtsam.Values:
        """Copy into a ``gtsam.Values`` (Pose3, 4-vector K, 1-vector S, Point3).

        Args:
            free: Rows to copy per group, (n,) bool; every row of every group when None.
        """
        values = gtsam.Values()
        for group, array in self.groups.items():
            if free is not None and group not in free:
                continue
            rows = range(len(array)) if free is None else np.flatnonzero(free[group]).tolist()
            for row in rows:
                value = gtsam.Pose3(array[row]) if group == "pose" else array[row]
                values.insert(self.key(group, row), value)
        return values

    def with_values(self, values: gtsam.Values) -> State:
        """Return this state with every row that ``values`` holds taken from there."""
        moved = {}
        for group, array in self.groups.items():
            out = array.copy()
            for row in range(len(array)):
                key = self.key(group, row)
                if values.exists(key):
                    out[row] = values_at(values, key, group)
            moved[group] = out
        return State(moved, self.names)


def values_at(values: gtsam.Values, key: int, group: str) -> FloatArray:
    """Read one variable of a ``gtsam.Values`` as an array with the layout of its group."""
    if group == "pose":
        return np.asarray(values.atPose3(key).matrix(), dtype=np.float64)
    if group in ("landmark", "dynamic_point"):
        return np.asarray(values.atPoint3(key), dtype=np.float64)
    return np.asarray(values.atVector(key), dtype=np.float64)
