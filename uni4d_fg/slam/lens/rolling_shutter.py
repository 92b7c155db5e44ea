"""Rolling shutters: rows that are read one after the other, and where tracks are when the middle row is.

A point that is seen in row v of an image was there at ``t + s``, ``s = readout (v / (height - 1) - 1 / 2)``, not at the
image's own time t, which is that of its middle row. Its track says how it moves, so that where it was at t follows from
where it was in the images before and after. Cameras that are solved on such tracks are those of the middle rows, and
need no poses of rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.frontend.track_model import LabelledTracks

Axis = Literal["rows", "columns"]


@dataclass(frozen=True)
class Readout:
    """How an image is read."""

    seconds: float
    """From the first to the last row or column; negative where the last one is read first."""
    axis: Axis = "rows"
    """Columns in a video that was turned by a right angle, as those of upright phones are."""

    def delay(self, uv: FloatArray, image_size: tuple[int, int]) -> FloatArray:
        """Return when pixels (..., 2) of an image (height, width) are seen, seconds after its middle."""
        along, size = (uv[..., 1], image_size[0]) if self.axis == "rows" else (uv[..., 0], image_size[1])
        return np.asarray(self.seconds * (along / max(size - 1, 1) - 0.5))

    def undone(
        self, uv: FloatArray, velocity: FloatArray, acceleration: FloatArray, image_size: tuple[int, int]
    ) -> FloatArray:
        """Return where pixels (..., 2) that move like that are when the middle of their image is read."""
        delay = self.delay(uv, image_size)[..., None]
        result: FloatArray = uv - delay * velocity + 0.5 * delay**2 * acceleration
        return result


def readout_to_array(readout: Readout | None) -> FloatArray:
    """Return a readout as an array (2,): seconds, NaN for none, and 1 for columns."""
    return np.array([np.nan, 0.0] if readout is None else [readout.seconds, float(readout.axis == "columns")])


def readout_of_array(array: FloatArray) -> Readout | None:
    """Return what :func:`readout_to_array` took."""
    return None if np.isnan(array[0]) else Readout(float(array[0]), "columns" if array[1] else "rows")


def at_one_time(
    labelled: LabelledTracks, readout: Readout | None, timestamps: FloatArray, image_size: tuple[int, int]
) -> LabelledTracks:
    """Return tracks at the places where they are when the middle of each image is read.

    The motion of each is the parabola through its places in the image and those before and after, a line where one of
    these is missing; a point that is seen once stays.

    Args:
        labelled: K tracks over T frames, on real pixels.
        readout: Of the camera; with None, they stay.
        timestamps: (T,) s, increasing.
        image_size: (height, width), px.
    """
    if readout is None:
        return labelled
    tracks = labelled.tracks
    uv = tracks.uv.astype(np.float64)
    moved = readout.undone(uv, *_motion(uv, tracks.visible, timestamps), image_size)
    return replace(labelled, tracks=replace(tracks, uv=moved.astype(np.float32)))


def _motion(uv: FloatArray, visible: BoolArray, timestamps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return velocities (K, T, 2), px/s, and accelerations (K, T, 2), px/s^2, of tracks (K, T, 2) in their images."""
    interval = np.diff(timestamps)[:, None]
    follows = (visible[:, 1:] & visible[:, :-1])[..., None]
    step = np.where(follows, np.diff(uv, axis=1) / interval, 0.0)
    before, after = np.zeros_like(uv), np.zeros_like(uv)
    before[:, 1:], after[:, :-1] = step, step
    has_before, has_after = np.zeros((*visible.shape, 1), np.bool_), np.zeros((*visible.shape, 1), np.bool_)
    has_before[:, 1:], has_after[:, :-1] = follows, follows
    # Velocities are those of the middles of the intervals: the one in between is nearer to the shorter interval's.
    share = np.full((len(timestamps), 1), 0.5)
    span = np.ones((len(timestamps), 1))
    if len(timestamps) > 2:
        span[1:-1] = 0.5 * (interval[1:] + interval[:-1])
        share[1:-1] = interval[1:] / (interval[1:] + interval[:-1])
    both = has_before & has_after
    velocity = np.where(both, share * before + (1.0 - share) * after, before + after)
    return velocity, np.where(both, (after - before) / span, 0.0)
