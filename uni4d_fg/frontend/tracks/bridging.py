"""Points that something passed in front of, found again behind it.

Every few frames a sweep remembers its points and the image. Points that were lost since together with most of those
around them were hidden: a thing in front takes neighbors along, a bad point is lost alone. Hidden points are looked for
in the frames that follow, in a view that is old enough to show nothing of what came in front:

1. Points that are still followed predict where they are (:mod:`uni4d_fg.frontend.tracks.transfer`).
2. A few are searched around there (normalized correlation). Only if neighbors among them are found with one offset from
   the prediction is it worth looking for the rest: where nothing came back, the search ends here.
3. Offsets of the nearest found ones correct the prediction, and every patch is registered from there; it must look the
   same, be near, and lead back (:mod:`uni4d_fg.frontend.tracks.registration`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.tracks.registration import cut_templates, register
from uni4d_fg.frontend.tracks.transfer import transfer

_INTERVAL = 5
"""Frames between two that are remembered and searched."""
_REMEMBERED = 4
_NEIGHBORS, _HIDDEN_PART = 8, 0.5
"""A point was hidden if this part of its neighbors was lost with it."""
_LEAST_GROUP, _LEAST_FOLLOWED, _MOST_FOLLOWED, _PROBES = 6, 40, 400, 48
_SIGMAS, _LEAST_RADIUS_PX, _LARGEST_RADIUS_PX = 3.0, 3, 24
_PROBE_CORRELATION, _CORRELATION, _NEAR_PX = 0.8, 0.85, 2.0
_AGREEMENT_PX, _AGREEING, _OF_NEAREST = 3.0, 3, 5
"""A probe counts if this many of the nearest ones, itself included, have its offset."""
_LEAST_AREA = 0.5
"""A view that is stretched or shrunk in area by more is not looked for."""

Found = tuple[IntArray, Float32Array]
"""Tracks (n,) and where they are, (n, 2) px."""


@dataclass(frozen=True)
class _Remembered:
    """A frame of the sweep."""

    image: ImageArray
    track: IntArray
    """(N,) followed there, ascending."""
    points: Float32Array
    """(N, 2) px."""

    @classmethod
    def of(cls, image: ImageArray, track: IntArray, points: Float32Array) -> _Remembered:
        order = np.argsort(track)
        return cls(image, track[order], points[order])

    def rows(self, track: IntArray) -> tuple[IntArray, BoolArray]:
        """Return the row of tracks (n,), and whether (n,) they were followed here; if not, the row means nothing."""
        if len(self.track) == 0:
            return np.zeros(len(track), np.int64), np.zeros(len(track), np.bool_)
        row = np.minimum(np.searchsorted(self.track, track), len(self.track) - 1)
        return row, self.track[row] == track


@dataclass
class _Hidden:
    """Points that were hidden together."""

    step: int
    """Of the sweep, when they were last followed."""
    seen: _Remembered
    """The frame in which they are known."""
    before: list[_Remembered]
    """Frames before that one, from the oldest."""
    track: IntArray
    """(N,) those that were not found yet."""

    def points(self) -> FloatArray:
        return self.seen.points[self.seen.rows(self.track)[0]].astype(np.float64)

    def predict(self, now: _Remembered) -> tuple[FloatArray, FloatArray]:
        """Return the warps (N, 6) and standard deviations (N,) px; NaN and infinite where nothing tells."""
        at = self.points()
        warp, sigma = np.full((len(at), 6), np.nan), np.full(len(at), np.inf)
        both, there, here = np.intersect1d(self.seen.track, now.track, assume_unique=True, return_indices=True)
        todo = np.ones(len(at), np.bool_)
        for before in (*self.before, None):
            # A point's parallax shows the better the longer it was followed; a young one has none to show.
            known, mine, displacement, at_displacement = np.arange(len(both)), todo, None, None
            if before is not None:
                known = np.flatnonzero(before.rows(both)[1])
                mine = todo & before.rows(self.track)[1]
            if len(known) < _LEAST_FOLLOWED or not mine.any():
                continue
            known = known[np.linspace(0, len(known) - 1, min(_MOST_FOLLOWED, len(known))).astype(np.int64)]
            source = self.seen.points[there[known]].astype(np.float64)
            if before is not None:
                displacement = source - before.points[before.rows(both[known])[0]]
                at_displacement = at[mine] - before.points[before.rows(self.track[mine])[0]]
            height, width = now.image.shape
            warp[mine], sigma[mine] = transfer(
                source, displacement, now.points[here[known]].astype(np.float64), at[mine], at_displacement,
                (height, width),
            )  # fmt: skip
            todo = todo & ~mine
        return warp, sigma


@dataclass
class Bridges:
    """What one sweep has lost from sight."""

    config: TrackingConfig
    _remembered: list[_Remembered] = field(default_factory=list)
    _hidden: list[_Hidden] = field(default_factory=list)
    _step: int = -1

    def find(self, image: ImageArray, track: IntArray, points: Float32Array) -> Found:
        """Return points that are in sight again; to be called in every step.

        Args:
            image: (H, W) uint8, the present one.
            track: (N,) that are followed.
            points: (N, 2) px where they are.
        """
        self._step += 1
        found: list[Found] = [(np.zeros(0, np.int64), np.zeros((0, 2), np.float32))]
        if self._step % _INTERVAL == 0:
            now = _Remembered.of(image, track, points)
            oldest = self._step - self.config.bridge_frames
            self._hidden = [group for group in self._hidden if group.step >= oldest]
            found += [_search(group, now, self.config.patch_px // 2, self.config) for group in self._hidden]
        again, where = (np.concatenate(parts) for parts in zip(*found, strict=True))
        if self._step % _INTERVAL == 0:
            self._remember(_Remembered.of(image, np.concatenate((track, again)), np.concatenate((points, where))))
        return again, where

    def _remember(self, now: _Remembered) -> None:
        """Note what was hidden since the frame that was remembered last."""
        if len(self._remembered) >= 2:
            *before, seen, last = self._remembered
            track = _lost_with_neighbors(last, now)
            old = seen.rows(track)[1]
            # Young tracks were not there yet: they are known in the last frame only.
            for view, earlier, members in ((seen, before, track[old]), (last, [], track[~old])):
                if len(members) >= _LEAST_GROUP:
                    self._hidden.append(_Hidden(self._step - _INTERVAL, view, earlier, members))
        self._remembered = [*self._remembered, now][-_REMEMBERED:]


def _lost_with_neighbors(last: _Remembered, now: _Remembered) -> IntArray:
    """Return the tracks that were followed in ``last``, and neither they nor most around them in ``now``."""
    gone = ~now.rows(last.track)[1]
    if len(gone) <= _NEIGHBORS or gone.sum() < _LEAST_GROUP:
        return np.zeros(0, np.int64)
    lost = np.flatnonzero(gone)
    _, near = cKDTree(last.points).query(last.points[lost], k=_NEIGHBORS + 1)
    hidden: IntArray = last.track[lost[gone[near[:, 1:]].mean(axis=1) >= _HIDDEN_PART]]
    return hidden


def _search(group: _Hidden, now: _Remembered, reach: int, config: TrackingConfig) -> Found:
    """Look for a group's points in the present image and take those that are found from the group."""
    nothing = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
    warp, sigma = group.predict(now)
    last_pixel = np.array(now.image.shape[::-1]) - 1
    row = np.flatnonzero(
        ((warp[:, :2] >= reach) & (warp[:, :2] <= last_pixel - reach)).all(axis=1) & _is_moderate(warp)
    )
    if len(row) < _LEAST_GROUP:
        return nothing
    source, warp, sigma = group.points()[row], warp[row], sigma[row]
    probe = np.linspace(0, len(row) - 1, min(_PROBES, len(row))).astype(np.int64)
    places = source[probe]
    offset, correlation = _probe(group.seen.image, now.image, places, warp[probe, :2], sigma[probe], reach)
    alike = np.flatnonzero(correlation >= _PROBE_CORRELATION)
    agreeing = alike[_agree(places[alike], offset[alike])]
    if len(agreeing) < _AGREEING:
        return nothing
    # What lies among probes that were not found is still hidden.
    _, nearest = cKDTree(places).query(source, k=_OF_NEAREST)
    promising = np.isin(nearest, agreeing).any(axis=1)
    row, source, warp = row[promising], source[promising], warp[promising]
    _, near = cKDTree(places[agreeing]).query(source, k=_AGREEING)
    warp[:, :2] += np.median(offset[agreeing][near], axis=1)
    there, found = _register_both_ways(group.seen.image, now.image, source, warp, config)
    track = group.track[row[found]]
    group.track = np.setdiff1d(group.track, track, assume_unique=True)
    return track, there[found]


def _probe(
    source: ImageArray, target: ImageArray, at: FloatArray, guess: FloatArray, sigma: FloatArray, reach: int
) -> tuple[FloatArray, FloatArray]:
    """Return where patches of an image are best found in another: (n, 2) px from the guess, and correlations (n,)."""
    offset, correlation = np.zeros((len(at), 2)), np.full(len(at), -1.0)
    radius = np.clip(np.ceil(_SIGMAS * sigma), _LEAST_RADIUS_PX, _LARGEST_RADIUS_PX).astype(np.int64)
    pixel, center = np.rint(at).astype(np.int64), np.rint(guess).astype(np.int64)
    first = np.maximum(center - radius[:, None] - reach, 0)
    end = center + radius[:, None] + reach + 1
    for n, (column, line) in enumerate(pixel):
        patch = source[max(line - reach, 0) : line + reach + 1, max(column - reach, 0) : column + reach + 1]
        window = target[first[n, 1] : end[n, 1], first[n, 0] : end[n, 0]]
        if patch.shape == (2 * reach + 1, 2 * reach + 1) and min(window.shape) > 2 * reach:
            _, correlation[n], _, place = cv2.minMaxLoc(cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED))
            offset[n] = first[n] + reach + np.array(place) + at[n] - pixel[n] - guess[n]
    return offset, correlation


def _agree(points: FloatArray, offset: FloatArray) -> BoolArray:
    """Return which of n points have an offset that others near them have."""
    if len(points) < _AGREEING:
        return np.zeros(len(points), np.bool_)
    _, near = cKDTree(points).query(points, k=min(_OF_NEAREST, len(points)))
    same = np.linalg.norm(offset[near] - offset[:, None], axis=2) <= _AGREEMENT_PX
    result: BoolArray = same.sum(axis=1) >= _AGREEING
    return result


def _register_both_ways(
    source: ImageArray, target: ImageArray, at: FloatArray, warp: FloatArray, config: TrackingConfig
) -> tuple[Float32Array, BoolArray]:
    """Return where patches around points (n, 2) are found, (n, 2) px, and whether (n,) they lead back."""
    index = np.arange(len(at))
    there, correlation = register(cut_templates(source, at.astype(np.float32), config.patch_px), index, target, warp)
    place = there[:, :2].astype(np.float32)
    found = (correlation >= _CORRELATION) & (np.linalg.norm(there[:, :2] - warp[:, :2], axis=1) <= _NEAR_PX)
    found &= _is_moderate(there)
    ahead = np.flatnonzero(found)
    inverse = np.linalg.inv(there[ahead, 2:].reshape(-1, 2, 2))
    start = at[ahead] - np.einsum("nij,nj->ni", inverse, there[ahead, :2] - warp[ahead, :2])
    back, correlation = register(
        cut_templates(target, place[ahead], config.patch_px), index[: len(ahead)], source,
        np.concatenate((start, inverse.reshape(-1, 4)), axis=1),
    )  # fmt: skip
    comes_back = np.linalg.norm(back[:, :2] - at[ahead], axis=1) <= config.forward_backward_px
    found[ahead] = comes_back & (correlation >= _CORRELATION)
    return place, found


def _is_moderate(warp: FloatArray) -> BoolArray:
    """Return (N,) where warps (N, 6) neither stretch nor shrink too much; False for NaN."""
    area = warp[:, 2] * warp[:, 5] - warp[:, 3] * warp[:, 4]
    result: BoolArray = (area >= _LEAST_AREA) & (area <= 1 / _LEAST_AREA)
    return result
