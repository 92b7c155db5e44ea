"""Evidence that follows what moves: what stands still for a moment has moved before, or will.

A dancer's hips rest while an arm swings, and a foot stays where it is until the next step. What pixels say of a surface
in one frame is therefore averaged with what they say of it in the frames before and behind, each weighing less by a
constant factor than the one before it. Surfaces are followed by optical flow, forward and back; where both disagree, or
the colors do, a surface has come out from behind another, or flow has lost it, and nothing is taken over.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice, pairwise
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.dense_flow import DenseFlow, warp_back
from uni4d_fg.optim.threads import thread_count, workers_in_order

_MOST = 4.0
"""Log odds that a single frame says at most: where an arm has passed is not to be remembered for long."""
_RETURN_PX, _RETURN_SHARE = 1.0, 0.1
"""Flow there and back ends where it began up to this, working px, and this part of its length."""
_BLUR_PX = 0.8
"""Colors are compared between images that are blurred by this, working px: flow is not exact."""
_BLOCK, _AHEAD = 32, 24
"""Frames that are averaged together, and how many behind them are looked at: no more than both are held."""

Half = npt.NDArray[np.float16]


class LookedAt(NamedTuple):
    """What was found in one frame alone."""

    image: ImageArray
    """(h, w, 3) at working size, RGB."""
    evidence: Float32Array
    """(h, w) log odds, ..."""
    weight: Float32Array
    """... and how much each counts beside that of other frames (h, w)."""


@dataclass(frozen=True)
class _Followed:
    """Where one frame is in another; held as halves."""

    flow: Half
    """(h, w, 2) px."""
    weight: Half
    """(h, w) from 0, not followed, to 1."""

    def carried(self, known: Float32Array, decay: float) -> Float32Array:
        """Return what the other frame knows, a sum and its weight (h, w, 2), at the pixels of this one."""
        weight = np.float32(decay) * self.weight.astype(np.float32)
        return weight[..., None] * warp_back(known, self.flow.astype(np.float32))


@dataclass(frozen=True)
class _Neighbors:
    """Two frames, one behind the other."""

    behind: _Followed
    """Where the first is in the second, ..."""
    before: _Followed
    """... and the second in the first."""


def averaged_over_time(frames: Iterator[LookedAt], config: MotionMaskConfig) -> Iterator[LookedAt]:
    """Yield the frames of a video in order, with the evidence of each averaged along optical flow.

    Args:
        frames: In order; some are taken ahead.
        config: How much of it the next frame keeps, and which colors are alike.
    """
    if config.memory == 0:
        yield from frames
        return
    with workers_in_order(thread_count()) as mapped:
        held = list(islice(frames, _BLOCK + _AHEAD))
        followed: list[_Neighbors] = []
        before: Float32Array | float = 0.0
        while held:
            pairs = list(pairwise(held))
            followed += mapped(partial(_neighbors, config=config), pairs[len(followed) :])
            done = _BLOCK if len(held) == _BLOCK + _AHEAD else len(held)
            for n, behind in enumerate(_from_behind(held, followed, config.memory)[:done]):
                known = before + _known(held[n])
                both = known + behind
                yield LookedAt(held[n].image, both[..., 0] / both[..., 1], both[..., 1])
                if n < len(followed):
                    before = followed[n].before.carried(known, config.memory)
            held, followed = held[done:] + list(islice(frames, done)), followed[done:]


def _known(frame: LookedAt) -> Float32Array:
    """Return what a frame knows by itself: a sum of evidence, and its weight, (h, w, 2)."""
    return np.stack([frame.weight * np.clip(frame.evidence, -_MOST, _MOST), frame.weight], axis=-1)


def _from_behind(held: list[LookedAt], followed: list[_Neighbors], decay: float) -> list[Float32Array]:
    """Return what is known from the frames behind each of n frames, (h, w, 2)."""
    found = [np.zeros((*frame.evidence.shape, 2), np.float32) for frame in held[-1:]]
    for frame, neighbors in zip(held[:0:-1], followed[::-1], strict=True):
        found.append(neighbors.behind.carried(_known(frame) + found[-1], decay))
    return found[::-1]


def _neighbors(pair: tuple[LookedAt, LookedAt], config: MotionMaskConfig) -> _Neighbors:
    """Follow two frames that are one behind the other."""
    grays = [np.asarray(cv2.cvtColor(one.image, cv2.COLOR_RGB2GRAY)) for one in pair]
    colors = [cv2.GaussianBlur(one.image.astype(np.float32), (0, 0), _BLUR_PX) for one in pair]
    flow = DenseFlow()  # none is shared: threads would write into each other's buffers
    there, back = flow.between(grays[0], grays[1]), flow.between(grays[1], grays[0])
    return _Neighbors(
        _followed(there, back, colors[0], colors[1], config), _followed(back, there, colors[1], colors[0], config)
    )


def _followed(
    flow: Float32Array, back: Float32Array, own: Float32Array, other: Float32Array, config: MotionMaskConfig
) -> _Followed:
    """Weigh a flow (h, w, 2) by how well the flow back, and the colors (h, w, 3) of both frames, agree with it."""
    miss = warp_back(back, flow, np.inf) + flow
    returns = np.hypot(miss[..., 0], miss[..., 1]) < _RETURN_PX + _RETURN_SHARE * np.hypot(flow[..., 0], flow[..., 1])
    red, green, blue = np.moveaxis(np.abs(warp_back(other, flow) - own), -1, 0)
    unlike = np.maximum(np.maximum(red, green), blue)
    weight = np.where(returns, np.exp(-((unlike / np.float32(config.memory_contrast)) ** 2)), 0)
    return _Followed(flow.astype(np.float16), weight.astype(np.float16))
