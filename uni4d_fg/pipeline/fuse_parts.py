"""Fusion on worker processes of this machine: each makes the frames of a part and writes their depth into the file.

What is made of a frame does not depend on which frames are made with it: the result is that of one process.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from uni4d_fg.arrays import ImageArray
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.dense_maps import DenseMaps
from uni4d_fg.pipeline.fused_frames import fused_frames
from uni4d_fg.pipeline.window_tasks import MadeItems
from uni4d_fg.pipeline.window_workers import WindowWorkers
from uni4d_fg.results.depth_store import DepthPlace, DepthWriter
from uni4d_fg.results.fusion.told_error import ToldError

_MOST_BYTES = 64 * 2**20
"""Frames that are in memory are sent to the workers if they take no more than this."""
_PARTS_PER_WORKER = 2
_LEAST_FRAMES = 32
"""Of a part: those near its ends are half made by its neighbor too."""


@dataclass(frozen=True)
class FusionPart:
    """Frames ``first`` to ``stop - 1``."""

    maps: DenseMaps
    """For these frames."""
    first: int
    stop: int
    place: DepthPlace


@dataclass(frozen=True)
class FusedPart:
    """What is not in the file of depth."""

    written: dict[int, int]
    """Frame to the checksum of its map."""
    confidence: list[ImageArray | None]
    """Of each frame, (h, w) in steps; None unless static depth is made as a field."""
    told: list[ToldError]
    """Of each frame."""
    matched: set[int]
    """Frames with depth from several views."""


def fuse_part(item: FusionPart, run: StageRunner, hooks: Hooks) -> FusedPart:
    """Make the frames of a part and write their depth.

    Raises:
        InputError: If a frame cannot be read.
        OutputError: If depth cannot be written.
    """
    confidence, told = list[ImageArray | None](), list[ToldError]()
    with item.place.opened() as writer:
        for fused in fused_frames(item.maps, item.first, item.stop):
            writer.write(fused.frame, fused.depth)
            confidence.append(fused.confidence)
            told.append(fused.told)
    return FusedPart(writer.written, confidence, told, item.maps.matched)


def fuse_in_parts(
    maps: DenseMaps, writer: DepthWriter, workers: WindowWorkers, advance: Callable[[int], None]
) -> Iterator[FusedPart]:
    """Make all frames on workers, which write their depth; yield the parts in their order.

    Args:
        maps: Which has tried matching.
        writer: Of the file of depth.
        workers: Processes of this machine.
        advance: Told how many frames are done.

    Raises:
        InputError: If a frame cannot be read.
        OutputError: If depth cannot be written.
        SolverError: If the process of a part died or was ended as often as it was tried.
        Cancelled: If the user interrupts.
    """
    edges, place = part_edges(writer.num_frames, workers.count), writer.place()

    def item(part: int) -> FusionPart:
        first, stop = edges[part], edges[part + 1]
        return FusionPart(maps.apart(first, stop), first, stop, place)

    waiting, next_part, done = dict[int, FusedPart](), 0, 0
    for part, fused in workers(fuse_part, MadeItems(range(len(edges) - 1), item)):
        writer.written.update(fused.written)
        maps.matched |= fused.matched
        done += len(fused.written)
        advance(done)
        waiting[part] = fused
        while next_part in waiting:
            yield waiting.pop(next_part)
            next_part += 1


def part_edges(num_frames: int, workers: int) -> list[int]:
    """Return where parts of about equal length begin, and the end of the last; they are as many as suits the workers.

    Args:
        num_frames: Of the video.
        workers: Processes.
    """
    count = max(1, min(_PARTS_PER_WORKER * workers, num_frames // _LEAST_FRAMES))
    return [int(edge) for edge in np.linspace(0, num_frames, count + 1).round()]


def can_be_sent(maps: DenseMaps) -> bool:
    """Tell whether other processes can read the frames: from files, or because they take little memory."""
    sequence = maps.sequence
    try:
        _Weighing().dump((sequence.images, sequence.depths, sequence.masks))
    except (pickle.PicklingError, TypeError, AttributeError):  # a source of somebody else, or too much
        return False
    return True


class _Weighing(pickle.Pickler):
    """Pickles without the content of arrays; raises PicklingError if they are too large together."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO())
        self._bytes = 0

    def reducer_override(self, thing: Any) -> Any:
        if not isinstance(thing, np.ndarray):
            return NotImplemented
        self._bytes += thing.nbytes
        if self._bytes > _MOST_BYTES:
            raise pickle.PicklingError("frames in memory")
        return int, ()
