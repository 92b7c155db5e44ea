"""Which frames see a frame well: enough parallax, not too much, and the same scene."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from uni4d_fg.arrays import FloatArray, evenly_spread
from uni4d_fg.config.multiview import MultiviewConfig
from uni4d_fg.geometry.camera import project

_MAX_POINTS = 1000
"""More landmarks do not tell better where a frame is seen from."""
_FARTHER, _FARTHER_STEP = 4, 4
"""A slow camera is followed so many times as far, in steps of so many frames."""


def choose_views(
    frame: int,
    world_T_cam: FloatArray,
    points: FloatArray,
    intrinsics: FloatArray,
    image_size: tuple[int, int],
    config: MultiviewConfig,
) -> list[int]:
    """Return the frames to match a frame with, best first; none where nothing has parallax.

    A view is worth the share of the points that it sees, times how near the median angle between the rays to them is
    to the wanted one. Views are taken from before and after in turn, so that what one side does not see the other may.
    Frames that are near in time look most alike: only where a camera is so slow that they have too few views among
    them, those farther away are asked, too.

    Args:
        frame: The frame.
        world_T_cam: (T, 4, 4).
        points: (N, 3) world, that the frame sees, m.
        intrinsics: (T, 4) px.
        image_size: (height, width), px.
        config: Views.
    """
    if len(points) < config.min_points:
        return []
    points = points[evenly_spread(len(points), _MAX_POINTS)]
    height, width = image_size
    here = points - world_T_cam[frame, :3, 3]
    worth: dict[int, float] = {}
    for other in _candidates(frame, len(world_T_cam), config.reach):
        if abs(other - frame) > config.reach and len(worth) >= config.views:
            break
        there = points - world_T_cam[other, :3, 3]
        seen_from = there @ world_T_cam[other, :3, :3]
        front = seen_from[:, 2] > 1e-6
        uv = project(intrinsics[other], np.where(front[:, None], seen_from, [0.0, 0.0, 1.0]))
        inside = front & (uv[:, 0] >= 0) & (uv[:, 1] >= 0) & (uv[:, 0] < width) & (uv[:, 1] < height)
        if inside.mean() < config.min_overlap:
            continue
        cosine = (here * there).sum(axis=1) / np.maximum(
            np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1), 1e-12
        )
        angle = float(np.degrees(np.median(np.arccos(np.clip(cosine[inside], -1.0, 1.0)))))
        if angle < config.min_angle_deg:
            continue
        ratio = angle / config.wanted_angle_deg
        worth[other] = float(inside.mean()) * min(ratio, 1.0 / ratio)
    sides = [sorted((o for o in worth if (o > frame) == after), key=lambda o: -worth[o]) for after in (False, True)]
    chosen = _spread(sides, config.views)
    return sorted(chosen, key=lambda other: -worth[other])


def _candidates(frame: int, num_frames: int, reach: int) -> Iterator[int]:
    """Yield the frames that may be views: all within reach, and some of those beyond, the nearest first."""
    distances = (*range(1, reach + 1), *range(reach + _FARTHER_STEP, _FARTHER * reach + 1, _FARTHER_STEP))
    for distance in distances:
        yield from (other for other in (frame - distance, frame + distance) if 0 <= other < num_frames)


def _spread(sides: list[list[int]], count: int) -> list[int]:
    """Take the best of each side in turn, until there are enough; one side gives what the other lacks."""
    each = [min(len(side), count // 2) for side in sides]
    for mine, its in ((0, 1), (1, 0)):
        each[mine] = min(len(sides[mine]), max(each[mine], count - each[its]))
    return [frame for side, number in zip(sides, each, strict=True) for frame in side[:number]][:count]
