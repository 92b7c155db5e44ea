"""Whether cameras are those of a thing that passes, while most of the picture is something else.

A ship that passes is full of edges, and what is seen of it agrees better than houses, quay and water do: so a start
from it may win. Its cameras leave most tracks over, those at the sides of the picture too; where a scene that is grown
from these explains more, that is the world.

A bus that passes a camera which hardly moves shows far more parallax than the street. Seen from the bus the camera
moves, the bus is the world, and the street, which only seems to turn, is about as good as infinitely far away: so every
start leads there. Of what such cameras leave over there is no scene: between any two frames a rotation explains it.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.structure.first_pair import has_parallax, median_motions, rank_pairs
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.hypotheses import at_sides
from uni4d_fg.cues.structure.judging import errors_of
from uni4d_fg.slam.stages.observations import Observations

_MOST = 0.5
"""Part of the tracks, in the picture and at its sides, that is left over: 0.08 to 0.25 by cameras of eight clips, 0.69
by those of a bus. People who fill the middle of the picture leave its sides to the world."""
_TURNED = 5.0
"""Times the least parallax by which what is left over moves, at least: a thing that is fixed to the camera does not."""


def most_left_over(scene: GrowingScene, used: Observations, image_size: tuple[int, int]) -> Observations | None:
    """Return what the cameras of a grown scene leave over; None where that is not most of what is seen.

    Args:
        scene: Grown and trimmed.
        used: Observations of tracks all over the picture.
        image_size: (height, width), px.
    """
    over = _left_over(scene, used)
    if _part(over, used) > _MOST and _part(over, used, at_sides(used, image_size)) > _MOST:
        return used.select(over)
    return None


def explains_more(scene: GrowingScene, other: GrowingScene, used: Observations, image_size: tuple[int, int]) -> bool:
    """Tell whether a scene leaves over less than another, of all tracks and of those at the sides of the picture."""
    ours, theirs = _left_over(scene, used), _left_over(other, used)
    sides = at_sides(used, image_size)
    return _part(ours, used) < _part(theirs, used) and _part(ours, used, sides) < _part(theirs, used, sides)


def only_seems_to_turn(
    rest: Observations, num_frames: int, intrinsics: FloatArray, config: GeometricDepthConfig, *, known_focal: bool
) -> bool:
    """Tell whether a rotation explains what cameras leave over: then the camera turns, and they are a thing's.

    Args:
        rest: What is left over.
        num_frames: T.
        intrinsics: (4,) px.
        config: Thresholds.
        known_focal: Whether the focal lengths are exact; else they are sought anew.
    """
    pairs = rank_pairs(rest, num_frames, intrinsics, config, known_focal=known_focal)
    if any(has_parallax(pair, config) for pair in pairs):
        return False
    return max(median_motions(rest, num_frames, config), default=0.0) >= _TURNED * config.min_parallax_px


def _left_over(scene: GrowingScene, used: Observations) -> BoolArray:
    """Return which observations (N,) are of tracks of which more than half are beyond the limit of a scene."""
    beyond = errors_of(scene.seeing(used), used) > scene.limit_px[used.frame]
    tracks, row = used.rows()
    over = 2 * np.bincount(row, beyond, len(tracks)) > np.bincount(row, minlength=len(tracks))
    return np.asarray(over[row])


def _part(over: BoolArray, used: Observations, where: BoolArray | None = None) -> float:
    """Return the part of the tracks that is left over, of all or of those whose observations (N,) are chosen."""
    inside = np.ones(len(over), dtype=bool) if where is None else where
    return len(np.unique(used.track[inside & over])) / max(len(np.unique(used.track[inside])), 1)
