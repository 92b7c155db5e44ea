"""What other frames show of the still scene where something is masked in this one.

A mask that reaches beyond what moves covers pixels of the still scene, too. Frames in which the thing has moved on show
their color and their depth: the scene beside the mask says about where to look, and the depth that the other frames
have there is taken back.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray
from uni4d_fg.results.fusion.pixel_transfer import pixel_transfer
from uni4d_fg.results.nearest import from_nearest

_ONE_SURFACE = 0.15
"""Another frame whose log depth differs by more from what is continued from beside the mask shows something else."""
_WHOLE = 0.99
"""Part of the pixels between which is read that have to be the still scene's."""
_MIN_FRAMES = 2
"""So many must show it: the mask of a single one may miss the thing itself."""
_LEAST_DEPTH_RATIO = 0.1
"""Pixels that are behind another camera or close to it are not looked up."""


class View(NamedTuple):
    """A frame at working size."""

    color: Float32Array
    """(h, w, 3) RGB, of 1."""
    inverse: Float32Array
    """(h, w) 1/m, of the still scene; NaN where unknown."""
    static: BoolArray
    """(h, w) neither masked nor beside a mask."""
    world_T_cam: FloatArray
    """(4, 4)."""
    intrinsics: FloatArray
    """(4,) px."""


class Background(NamedTuple):
    """What others show, (h, w); means nothing where nothing is seen."""

    color: Float32Array
    """(h, w, 3) mean, of 1."""
    variance: Float32Array
    """(h, w, 3) of the frames' colors about it."""
    inverse: Float32Array
    """1/m."""
    seen: BoolArray


def background(view: View, others: Iterable[View], where: BoolArray) -> Background:
    """Look up in other frames what is behind a mask.

    Args:
        view: The frame.
        others: Frames that may show it.
        where: (h, w) where it is wanted.
    """
    shape = where.shape
    out = Background(
        np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32),
        np.zeros(shape, np.bool_),
    )  # fmt: skip
    known = view.static & np.isfinite(view.inverse)
    if not where.any() or not known.any():
        return out
    box = tuple(slice(at.min(), at.max() + 1) for at in np.nonzero(where))
    y, x = np.mgrid[box].astype(np.float32)
    guess = from_nearest(view.inverse, known)[box]
    count, total = np.zeros(guess.shape, np.float32), np.zeros(guess.shape, np.float32)
    color, square = np.zeros((*guess.shape, 3), np.float32), np.zeros((*guess.shape, 3), np.float32)
    for other in others:
        other_T_cam = np.asarray(np.linalg.solve(other.world_T_cam, view.world_T_cam))
        transfer = pixel_transfer(view.intrinsics, other.intrinsics, other_T_cam)
        turn, shift = (part.astype(np.float32) for part in transfer)
        a, b, ratio = (turn[i, 0] * x + (turn[i, 1] * y + turn[i, 2]) + guess * shift[i] for i in range(3))
        ahead = ratio > _LEAST_DEPTH_RATIO
        ratio = np.where(ahead, ratio, np.float32(1))
        u, v = a / ratio, b / ratio
        usable = other.static & np.isfinite(other.inverse)
        there = cv2.remap(np.where(usable, other.inverse, np.float32(0)), u, v, cv2.INTER_LINEAR)
        shown = ahead & (cv2.remap(usable.astype(np.float32), u, v, cv2.INTER_LINEAR) > _WHOLE)
        found = np.where(shown, there, np.float32(1)) * ratio
        shown &= np.abs(np.log(found / guess)) < _ONE_SURFACE
        seen = cv2.remap(other.color, u, v, cv2.INTER_LINEAR)
        seen *= shown[..., None]
        count += shown
        total += found * shown
        color += seen
        square += seen**2
    some = np.maximum(count, 1)
    mean = color / some[..., None]
    out.color[box], out.inverse[box], out.seen[box] = mean, total / some, count >= _MIN_FRAMES
    out.variance[box] = np.maximum(square / some[..., None] - mean**2, 0)
    return out
