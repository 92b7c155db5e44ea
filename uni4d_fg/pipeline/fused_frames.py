"""Fused depth frame by frame, in this process, with what is told of each frame's error."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.optim.threads import workers_in_order
from uni4d_fg.pipeline.dense_maps import DenseMaps
from uni4d_fg.results.confidence_store import in_steps
from uni4d_fg.results.fusion.told_error import ToldError

_FRAMES_PER_THREAD = 2
"""Threads wait for each other once per as many frames."""


class FusedFrame(NamedTuple):
    """What is made of one frame."""

    frame: int
    depth: Float32Array
    """(H, W) m."""
    confidence: ImageArray | None
    """(h, w) in steps, as it is stored; None unless static depth is made as a field."""
    told: ToldError
    """Of this frame alone."""


def fused_frames(maps: DenseMaps, first: int, stop: int) -> Iterator[FusedFrame]:
    """Yield frames ``first`` to ``stop - 1``, in order, made on as many threads as ``maps`` has."""
    together = _FRAMES_PER_THREAD * maps.threads
    with workers_in_order(maps.threads) as mapped:
        for start in range(first, stop, together):
            frames = list(range(start, min(start + together, stop)))
            maps.prepare(frames, mapped)
            for frame, (depth, static) in zip(frames, mapped(maps.final, frames), strict=True):
                told = ToldError(maps.is_interpolated)
                if static is None:
                    yield FusedFrame(frame, depth, None, told)
                    continue
                told.add(
                    static.log_depth, static.confidence, static.still, *maps.landmarks_in(frame),
                    common_sigma=maps.common_sigma(frame),
                )  # fmt: skip
                yield FusedFrame(frame, depth, in_steps(static.confidence), told)
