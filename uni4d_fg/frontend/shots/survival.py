"""How many corners outlive a span of frames: across a dissolve all of them fade away, wherever they are.

Corners of every few frames are followed from frame to frame, and at the end of a span compared with what they looked
like at its beginning. Those that leave the image count neither way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array
from uni4d_fg.config.shots import ShotsConfig
from uni4d_fg.frontend.shots.links import SmallFrame, flow, similarity

_BORDER = 0.06
"""Part of the longer side within which a lost corner counts as one that left the image."""


@dataclass(frozen=True)
class Span:
    """What became of the corners of one frame by a later one."""

    first: int
    last: int
    alive: float
    """Part of those that did not leave the image."""


@dataclass
class _Corners:
    born: int
    start: Float32Array
    now: Float32Array
    alive: BoolArray
    left: BoolArray


def spans(frames: list[SmallFrame], steps: list[int | None], config: ShotsConfig) -> Iterator[Span]:
    """Yield what became of corners over ``config.dissolve_spans``.

    Args:
        frames: T frames.
        steps: (T,) the earlier frame from which corners are followed to each frame: the one before, or where that is a
            flash, one before it; None where nothing connects a frame with earlier ones or the image moves too fast,
            so that all corners are given up; its own number where they wait.
        config: Spans and checks.
    """
    every = max(2, min(config.dissolve_spans) // 3)
    following: list[_Corners] = []
    for t, frame in enumerate(frames):
        came_from = steps[t]
        if came_from is None:
            following = []
        elif came_from != t and following:
            _follow(following, frames[came_from], frame, config)
        if came_from == t:
            continue
        still = []
        for corners in following:
            age = t - corners.born
            ends = [span for span in config.dissolve_spans if corners.born + span <= t]
            judged = [span for span in ends if steps_between(steps, corners.born + span, t)]
            if judged:
                found = _alive(corners, frames[corners.born], frame, config)
                if found is not None:
                    yield Span(corners.born, t, found)
            if age < max(config.dissolve_spans):
                still.append(corners)
        following = still
        if t % every == 0 and frame.shows_something:
            count = len(frame.corners)
            start = frame.corners
            following.append(_Corners(t, start, start.copy(), np.ones(count, np.bool_), np.zeros(count, np.bool_)))


def steps_between(steps: list[int | None], wanted: int, now: int) -> bool:
    """Tell whether ``now`` is the first frame from ``wanted`` on at which corners are not waiting."""
    return all(steps[t] == t for t in range(wanted, now))


def _follow(following: list[_Corners], source: SmallFrame, target: SmallFrame, config: ShotsConfig) -> None:
    """Move all living corners by one step."""
    chosen = [np.flatnonzero(corners.alive) for corners in following]
    points = np.concatenate([corners.now[rows] for corners, rows in zip(following, chosen, strict=True)])
    if len(points) == 0:
        return
    moved, found = flow(source.local, target.local, points, points)
    back, found_back = flow(target.local, source.local, moved, points)
    kept = found & found_back & (np.linalg.norm(back - points, axis=1) <= config.forward_backward_px)
    height, width = target.size
    margin = _BORDER * max(height, width)
    outside: BoolArray = np.asarray(
        ((moved < margin) | (moved > (width - 1 - margin, height - 1 - margin))).any(axis=1), np.bool_
    )
    beyond: BoolArray = np.asarray(((moved < 2) | (moved > (width - 3, height - 3))).any(axis=1), np.bool_)
    begin = 0
    for corners, rows in zip(following, chosen, strict=True):
        part = slice(begin, begin + len(rows))
        begin += len(rows)
        corners.now[rows] = moved[part]
        corners.alive[rows] = kept[part] & ~beyond[part]
        corners.left[rows] = (~kept[part] | beyond[part]) & outside[part]


def _alive(corners: _Corners, source: SmallFrame, target: SmallFrame, config: ShotsConfig) -> float | None:
    """Return the part of the corners that is still there; None where too few had to be."""
    stayed = ~corners.left
    if stayed.sum() < config.min_corners or stayed.mean() < config.min_overlap:
        return None
    rows = np.flatnonzero(corners.alive)
    same = similarity(source.local, target.local, corners.start[rows], corners.now[rows], config.patch_px)
    return float((same >= config.min_lasting_similarity).sum() / stayed.sum())
