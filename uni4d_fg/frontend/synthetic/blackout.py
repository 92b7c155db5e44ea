"""Frames in which nothing is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Sequence
from uni4d_fg.frontend.track_model import Tracks


def black_out(sequence: Sequence, first: int, count: int) -> Sequence:
    """Return a sequence that sees nothing in ``count`` frames from ``first`` on: black images, no depth, no mask.

    No track survives: those that are seen again are other tracks after the blackout.

    Args:
        sequence: With tracks; all of it is held in memory.
        first: First black frame.
        count: Number of black frames.

    Raises:
        ValueError: If the frames are not inside the sequence, or it has no tracks.
    """
    if sequence.tracks is None or not 0 < first <= first + count < sequence.num_frames:
        raise ValueError(f"frames {first} to {first + count - 1} are not inside a sequence with tracks")
    dark = slice(first, first + count)
    images, depths, masks = (np.stack(list(s)) for s in (sequence.images, sequence.depths, sequence.masks))
    images[dark], depths[dark], masks[dark] = 0, np.nan, 0
    visible = sequence.tracks.visible
    parts, kept = [], []
    for seen in (slice(0, first), slice(first + count, None)):
        part = np.zeros_like(visible)
        part[:, seen] = visible[:, seen]
        rows = np.flatnonzero(part.any(axis=1))
        start = np.argmax(part[rows], axis=1)
        query = np.where(part[rows, sequence.tracks.query_frame[rows]], sequence.tracks.query_frame[rows], start)
        uv = np.where(part[rows][..., None], sequence.tracks.uv[rows], np.float32(np.nan))
        parts.append(Tracks(uv, part[rows], query.astype(np.int32)))
        kept.append(rows)
    tracks = Tracks(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("uv", "visible", "query_frame")))
    truth: GroundTruth = sequence.ground_truth
    if truth.track_points is not None:
        truth = replace(truth, track_points=truth.track_points[np.concatenate(kept)])
    return replace(
        sequence, images=ArrayFrames(images), depths=ArrayFrames(depths), masks=ArrayFrames(masks), tracks=tracks,
        ground_truth=truth,
    )  # fmt: skip
