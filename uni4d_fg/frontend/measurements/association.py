"""Which measurement belongs to which frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.errors import InputError
from uni4d_fg.geometry.trajectory import nearest_in_time


def rows_of_frames(path: Path, times: FloatArray, timestamps: FloatArray, tolerance_s: float) -> IntArray:
    """Return per frame (T,) the measurement nearest in time; -1 where none is near.

    A measurement belongs to one frame at most, the nearest.

    Args:
        path: Where the measurements are from, for the message.
        times: (N,) s of the measurements, not decreasing, N > 0.
        timestamps: (T,) s of the frames, increasing.
        tolerance_s: Largest distance, s.

    Raises:
        InputError: If no frame has one.
    """
    row, distance = nearest_in_time(timestamps, times)
    frame, _ = nearest_in_time(times, timestamps)
    near = (distance <= tolerance_s) & (frame[row] == np.arange(len(timestamps)))
    if not near.any():
        raise InputError(
            f"{path}: no row is within {tolerance_s:g} s of a frame: the file covers {times[0]:.3f} to {times[-1]:.3f} "
            f"s, the frames {timestamps[0]:.3f} to {timestamps[-1]:.3f} s; give both the same clock (timestamps.txt of "
            "the sequence), or raise measurements.tolerance_s"
        )
    return np.where(near, row, -1)
