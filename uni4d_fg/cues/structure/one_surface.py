"""Tracks that go over from one static surface to another: which of their observations are of the other one.

A point near the edge of what hides it is captured by that edge (a pole, a door, a leaf): its track is that of one
static point up to there, and that of another one afterwards. Taken as a whole it contradicts a static scene, as if
something moved, and its mean is on neither surface. With the cameras it is told apart from what moves: both parts are
explained by points that stand still.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.cues.structure.triangulation import RayBundle, triangulate

_WINDOWS = ((0.0, 0.4), (0.3, 0.7), (0.6, 1.0))
"""Parts of a track from which its point is looked for."""
_WHOLE = 0.9
"""A track whose point explains this part of it is of one surface."""
_LEAST, _LEAST_PART = 6, 0.3
"""What is kept has so many observations, and is this part of the track."""
_EXPLAINED = 0.75
"""Both points explain this part of what is theirs."""


def strays(rays: RayBundle, error_px: FloatArray, limit_px: float, huber_px: float) -> BoolArray:
    """Return which rays (N,) are of another static surface than most of their track is.

    Args:
        rays: Those of a track in the order of time.
        error_px: (N,) of the points of whole tracks.
        limit_px: Up to this error a point explains a ray.
        huber_px: Of the triangulation.
    """
    total = np.bincount(rays.row, minlength=rays.count)
    out = np.zeros(len(rays.row), np.bool_)
    with np.errstate(invalid="ignore"):
        mixed = (_count(rays, error_px <= limit_px) < _WHOLE * total) & (total >= 2 * _LEAST)
    chosen = mixed[rays.row]
    if not chosen.any():
        return out
    number = np.cumsum(mixed) - 1
    rays, total = replace(rays.select(chosen), row=number[rays.row[chosen]], count=int(mixed.sum())), total[mixed]
    part = _place(rays)
    best = np.zeros(len(rays.row), np.bool_)
    for first, last in _WINDOWS:
        found = _fits(rays, (part >= first) & (part <= last), limit_px, huber_px)
        better = _count(rays, found) > _count(rays, best)
        best = np.where(better[rays.row], found, best)
    best = _fits(rays, best, limit_px, huber_px)
    kept, before, after = _parts(rays, best)
    good = (_count(rays, kept) >= np.maximum(_LEAST, _LEAST_PART * total)) & _explains(rays, kept, best)
    for rest in (before, after):
        theirs = _fits(rays, rest, limit_px, huber_px)
        good &= _explains(rays, rest, theirs) | (_count(rays, rest) == 0)
    out[chosen] = (before | after) & good[rays.row]
    return out


def _fits(rays: RayBundle, which: BoolArray, limit_px: float, huber_px: float) -> BoolArray:
    """Return which rays (N,) the points explain that are found from some of them."""
    points = triangulate(rays.select(which), huber_px)
    with np.errstate(invalid="ignore"):
        return np.asarray(points.errors_of(rays) <= limit_px)


def _count(rays: RayBundle, which: BoolArray) -> IntArray:
    """Return how many of some rays (N,) each track (M,) has."""
    return np.bincount(rays.row[which], minlength=rays.count)


def _explains(rays: RayBundle, theirs: BoolArray, fits: BoolArray) -> BoolArray:
    """Return the tracks (M,) most of whose rays ``theirs`` fit."""
    return np.asarray(_count(rays, theirs & fits) >= _EXPLAINED * _count(rays, theirs))


def _place(rays: RayBundle) -> FloatArray:
    """Return where in its track each ray (N,) is, from 0 to 1."""
    first = np.flatnonzero(np.diff(rays.row, prepend=-1))
    length = np.diff(np.append(first, len(rays.row)))
    within = np.arange(len(rays.row)) - np.repeat(first, length)
    return np.asarray(within / np.repeat(np.maximum(length - 1, 1), length))


def _parts(rays: RayBundle, fits: BoolArray) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return the rays (N,) from the first that fits to the last of each track, those before, and those after."""
    at = np.arange(len(rays.row))
    first, last = np.full(rays.count, len(at)), np.full(rays.count, -1)
    np.minimum.at(first, rays.row[fits], at[fits])
    np.maximum.at(last, rays.row[fits], at[fits])
    before, after = at < first[rays.row], at > last[rays.row]
    return ~before & ~after, before, after
