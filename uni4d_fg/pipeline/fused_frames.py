"""Fused depth frame by frame, in this process, with what is told of each frame's error."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from functools import partial
from typing import NamedTuple

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.optim.threads import OrderedMap, made_ahead, workers_in_order
from uni4d_fg.pipeline.dense_maps import DenseMaps
from uni4d_fg.results.confidence_store import in_steps
from uni4d_fg.results.fusion.told_error import ToldError

_FRAMES_PER_THREAD = 2
"""So many frames are finished while as many that follow them are prepared."""


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
    with workers_in_order(maps.threads) as mapped:
        for frames in made_ahead(_prepared(maps, first, stop, mapped), maps.threads, ahead=1):
            yield from mapped(partial(_fused, maps), frames)


def _prepared(maps: DenseMaps, first: int, stop: int, mapped: OrderedMap) -> Generator[list[int], None, None]:
    """Yield frames that follow each other when they are prepared; those yielded last need not be finished by then."""
    together = _FRAMES_PER_THREAD * maps.threads
    for start in range(first, stop, together):
        frames = list(range(start, min(start + together, stop)))
        maps.prepare(frames, mapped, unfinished=max(first, start - together))
        yield frames


def _fused(maps: DenseMaps, frame: int) -> FusedFrame:
    depth, static = maps.final(frame)
    told = ToldError(maps.is_interpolated)
    if static is None:
        return FusedFrame(frame, depth, None, told)
    told.add(
        static.log_depth, static.confidence, static.still, *maps.landmarks_in(frame),
        common_sigma=maps.common_sigma(frame),
    )  # fmt: skip
    return FusedFrame(frame, depth, in_steps(static.confidence), told)
