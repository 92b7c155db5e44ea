"""A bar that passes in front of the camera: every pixel is hidden for a while, tracks end and start anew."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Sequence
from uni4d_fg.frontend.track_model import Tracks

_GRAY = 90


@dataclass(frozen=True)
class Occluded:
    """A sequence seen behind the bar."""

    sequence: Sequence
    earlier: IntArray
    """(N,) tracks that are seen before and after the bar, as far as it hid them."""
    later: IntArray
    """(N,) the tracks that continue them."""


def pass_bar(sequence: Sequence, hidden: int, first: int = 5) -> Occluded:
    """Return the sequence behind a vertical bar that crosses the image from left to right, and hides tracks for good.

    A point that stands still is hidden for ``hidden`` frames. What is seen of a track behind the bar is a track of its
    own, with the next free number. The bar is painted into the images; depth and masks know nothing of it.

    Args:
        sequence: With tracks; images are held in memory.
        hidden: Frames for which a column is hidden.
        first: Frame in which the bar enters; it has left as many frames before the end.

    Raises:
        ValueError: If the sequence has no tracks, or is too short for the bar to pass.
    """
    num_frames, width = sequence.num_frames, sequence.image_size[1]
    if sequence.tracks is None or hidden < 1 or num_frames - 2 * first <= hidden:
        raise ValueError(f"a bar that hides for {hidden} frames cannot pass within {num_frames} frames with tracks")
    speed = width / (num_frames - 2 * first - hidden)
    front = speed * (np.arange(num_frames) - first)
    back = front - speed * hidden
    images = np.stack(list(sequence.images))
    column = np.arange(width)
    for frame in range(num_frames):
        images[frame][:, (column >= back[frame]) & (column < front[frame])] = _GRAY
    tracks = sequence.tracks
    u: FloatArray = tracks.uv[..., 0].astype(np.float64)
    with np.errstate(invalid="ignore"):
        before: BoolArray = tracks.visible & (u >= front)
        behind: BoolArray = tracks.visible & (u < back)
    ahead: BoolArray = np.asarray(before.any(axis=1))
    earlier = np.flatnonzero(ahead & behind.any(axis=1))
    # A track that is seen only behind the bar keeps its number.
    kept: BoolArray = np.where(ahead[:, None], before, behind)
    visible = np.concatenate((kept, behind[earlier]))
    rows = np.concatenate((np.arange(len(kept)), earlier))
    seen = np.flatnonzero(visible.any(axis=1))
    visible, rows = visible[seen], rows[seen]
    number = np.full(len(kept) + len(earlier), -1)
    number[seen] = np.arange(len(seen))
    query = tracks.query_frame[rows]
    query = np.where(visible[np.arange(len(rows)), query], query, visible.argmax(axis=1))
    uv = np.where(visible[..., None], tracks.uv[rows], np.float32(np.nan))
    truth: GroundTruth = sequence.ground_truth
    if truth.track_points is not None:
        truth = replace(truth, track_points=truth.track_points[rows])
    return Occluded(
        replace(
            sequence, images=ArrayFrames(images), tracks=Tracks(uv, visible, query.astype(np.int32)), ground_truth=truth
        ),
        number[earlier],
        number[len(kept) + np.arange(len(earlier))],
    )
