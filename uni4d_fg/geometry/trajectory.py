"""Camera trajectories: poses with their times, and which of two trajectories' poses belong together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.errors import InputError


@dataclass(frozen=True)
class Trajectory:
    """Camera poses with their times.

    Raises:
        InputError: If the shapes disagree, there is no pose, or a value is not finite.
    """

    timestamps: FloatArray
    """(T,) seconds, not decreasing."""
    world_T_cam: FloatArray
    """(T, 4, 4) camera to world, meters."""

    def __post_init__(self) -> None:
        count = len(self.timestamps)
        if count == 0 or self.timestamps.shape != (count,) or self.world_T_cam.shape != (count, 4, 4):
            raise InputError(
                f"trajectory: timestamps {self.timestamps.shape} and poses {self.world_T_cam.shape} "
                "must be (T,) and (T, 4, 4) with T > 0"
            )
        bad = np.flatnonzero(~(np.isfinite(self.world_T_cam).all(axis=(1, 2)) & np.isfinite(self.timestamps)))
        if len(bad):
            raise InputError(f"trajectory: pose {bad[0]} has a value that is NaN or infinite")

    def __len__(self) -> int:
        return len(self.timestamps)

    def select(self, frames: IntArray) -> Trajectory:
        """Return the poses at the given indices."""
        return Trajectory(self.timestamps[frames], self.world_T_cam[frames])


def nearest_in_time(times: FloatArray, reference: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return per time (N,) the index of the nearest reference time, and its distance (N,) s; of two, the earlier.

    Args:
        times: (N,) seconds.
        reference: (M,) seconds, not decreasing, M > 0.
    """
    after = np.clip(np.searchsorted(reference, times, side="right"), 0, len(reference) - 1)
    before = np.maximum(after - 1, 0)
    ahead = np.abs(reference[after] - times)
    behind = np.abs(times - reference[before])
    return np.where(ahead < behind, after, before), np.minimum(ahead, behind)


def associate(
    estimate: Trajectory, reference: Trajectory, *, tolerance_s: float = 0.01
) -> tuple[Trajectory, Trajectory]:
    """Pair poses by time: each pose of the shorter trajectory takes the nearest one of the longer.

    Returns:
        Both trajectories, reduced to the pairs whose times differ by no more than ``tolerance_s``.

    Raises:
        InputError: If no pair is that close.
    """
    swap = len(estimate) > len(reference)
    short, long = (reference, estimate) if swap else (estimate, reference)
    nearest, distance = nearest_in_time(short.timestamps, long.timestamps)
    close = np.flatnonzero(distance <= tolerance_s)
    if len(close) == 0:
        raise InputError(
            f"no two poses lie within {tolerance_s:g} s: the estimate covers "
            f"{estimate.timestamps[0]:.3f} to {estimate.timestamps[-1]:.3f} s, the ground truth "
            f"{reference.timestamps[0]:.3f} to {reference.timestamps[-1]:.3f} s"
        )
    pair = short.select(close), long.select(nearest[close])
    return (pair[1], pair[0]) if swap else pair
