"""Points that something passed in front of, found again behind it.

Every few frames a sweep remembers its points and the image, and learns from them how the still scene moves and how
far away its points are (:mod:`uni4d_fg.frontend.tracks.scene_motion`). Points that were lost since together with
others around them were hidden: a thing in front takes neighbors along, a bad point is lost alone. They go on as the
scene does, unseen, and are looked for in the frames that follow, in a view that is old enough to show nothing of what
came in front:

1. Each is searched around where it should be, as far as that is uncertain (normalized correlation). Only where
   neighbors are found with one offset is it worth looking on: elsewhere nothing came back.
2. Offsets of the nearest found ones correct the others, and every patch is registered from there; it must look the
   same, be near, and lead back (:mod:`uni4d_fg.frontend.tracks.registration`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import cv2
import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.tracks.registration import cut_templates, register
from uni4d_fg.frontend.tracks.scene_motion import Known, Motion, fit

_INTERVAL = 5
"""Frames between two that are remembered and searched."""
_NEIGHBORS, _HIDDEN_PART = 8, 0.5
"""A point was hidden if this part of its neighbors was lost with it."""
_LEAST_FOLLOWED = 12
_SIGMAS, _LEAST_RADIUS_PX, _LARGEST_RADIUS_PX = 3.0, 3, 24
_LEAST_CORRELATION, _PROBE_CORRELATION, _CORRELATION, _NEAR_PX = 0.6, 0.8, 0.85, 2.0
_AGREEMENT_PX, _AGREEING, _OF_NEAREST = 2.0, 3, 5
"""A probe counts if this many of the nearest ones, itself included, have its offset."""
_LEAST_AREA = 0.5
"""A view that is stretched or shrunk in area by more is not looked for."""
_NEW_SIGMA, _DRIFT, _NEW_STILL, _LEAST_STILL = (0.1, 0.5), 0.005, (0.1, 0.5, 0.9), 0.4
"""What is known of the inverse depth of new points, as a part of it; what it loses between two frames; how likely it is
that they are at rest: at least, at most, and in the first frame."""

Found = tuple[IntArray, Float32Array]
"""Tracks (n,) and where they are, (n, 2) px."""


@dataclass(frozen=True)
class _Remembered:
    """A frame of the sweep."""

    image: ImageArray
    track: IntArray
    """(N,) followed there, ascending."""
    points: FloatArray
    """(N, 2) px."""
    known: Known

    def rows(self, track: IntArray) -> tuple[IntArray, BoolArray]:
        """Return the row of tracks (n,), and whether (n,) they were followed here; if not, the row means nothing."""
        if len(self.track) == 0:
            return np.zeros(len(track), np.int64), np.zeros(len(track), np.bool_)
        row = np.minimum(np.searchsorted(self.track, track), len(self.track) - 1)
        return row, self.track[row] == track


@dataclass
class _Hidden:
    """Points (N,) that are hidden at present."""

    track: IntArray
    step: IntArray
    """Of the sweep, when they were last followed."""
    view: IntArray
    """The image in which they are known."""
    at: FloatArray
    """(N, 2) px in that image."""
    still: FloatArray
    points: FloatArray
    """(N, 2) px where they should be."""
    affine: FloatArray
    """(N, 2, 2) from their view to the present."""
    inverse_depth: FloatArray
    sigma: FloatArray
    """Its standard deviation."""
    error: FloatArray
    """(N, 2) px by which they are off if their inverse depth is by one standard deviation."""
    variance: FloatArray
    """px^2, of ``points``, by what is not known of the camera."""

    @classmethod
    def none(cls) -> _Hidden:
        return cls.of(np.zeros(0, np.int64), 0, 0, np.zeros((0, 2)), Known(np.zeros(0), np.zeros(0), np.zeros(0)))

    @classmethod
    def of(cls, track: IntArray, step: int, view: int, at: FloatArray, known: Known) -> _Hidden:
        count = len(track)
        return cls(
            track, np.full(count, step), np.full(count, view), at, known.still, at.copy(),
            np.tile(np.eye(2), (count, 1, 1)), known.inverse_depth, known.sigma, np.zeros((count, 2)), np.zeros(count),
        )  # fmt: skip

    def joined(self, other: _Hidden) -> _Hidden:
        return _Hidden(*(np.concatenate((getattr(self, f.name), getattr(other, f.name))) for f in fields(self)))

    def picked(self, rows: BoolArray | IntArray) -> _Hidden:
        return _Hidden(*(getattr(self, f.name)[rows] for f in fields(self)))

    def move(self, motion: Motion) -> None:
        """Go on as the scene does."""
        by_motion = motion.by_motion(self.points, self.inverse_depth)
        by_depth, change = motion.by_inverse_depth(self.points, self.inverse_depth)
        moved, inverse_depth = motion.move(self.points, self.inverse_depth)
        beside = [motion.move(self.points + step, self.inverse_depth)[0] - moved for step in np.eye(2)]
        affine = np.stack(beside, axis=2)
        self.error = np.einsum("nij,nj->ni", affine, self.error) + by_depth * self.sigma[:, None]
        area = np.abs(np.linalg.det(affine))
        self.variance = area * self.variance + 0.5 * ((by_motion @ motion.covariance) * by_motion).sum(axis=(1, 2))
        self.affine = affine @ self.affine
        self.points, self.inverse_depth, self.sigma = moved, inverse_depth, self.sigma * change

    def known(self) -> Known:
        return Known(self.inverse_depth, self.sigma, self.still)

    def spread(self) -> FloatArray:
        """Return the standard deviations (N, 2) px of where they are."""
        result: FloatArray = np.sqrt(self.variance[:, None] + self.error**2)
        return result


@dataclass
class Bridges:
    """What one sweep has lost from sight."""

    config: TrackingConfig
    frames: int
    """For how many what is hidden is looked for."""
    _remembered: list[_Remembered] = field(default_factory=list)
    """The last two frames."""
    _motions: list[Motion] = field(default_factory=list)
    """Between them, and from the second one to the present."""
    _views: dict[int, ImageArray] = field(default_factory=dict)
    _hidden: _Hidden = field(default_factory=_Hidden.none)
    _step: int = -1

    def find(self, image: ImageArray, track: IntArray, points: Float32Array) -> Found:
        """Return points that are in sight again; to be called in every step.

        Args:
            image: (H, W) uint8, the present one.
            track: (N,) that are followed.
            points: (N, 2) px where they are.
        """
        self._step += 1
        nothing = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        if self._step % _INTERVAL != 0:
            return nothing
        order = np.argsort(track)
        track, at = track[order], points[order].astype(np.float64)
        known = self._learn(image, track, at)
        self._hide(track)
        rows, there = _search(self._hidden, self._views, image, self.config)
        found = self._hidden.picked(rows)
        keep = np.ones(len(self._hidden.track), np.bool_)
        keep[rows] = False
        self._hidden = self._hidden.picked(keep)
        again = found.known()
        self._remember(
            image,
            np.concatenate((track, found.track)),
            np.concatenate((at, there)),
            Known(*(np.concatenate((getattr(known, f.name), getattr(again, f.name))) for f in fields(Known))),
        )
        return found.track, there.astype(np.float32)

    def _learn(self, image: ImageArray, track: IntArray, at: FloatArray) -> Known:
        """Find how the scene moved, and return what is known of the points (N,): NaN for new ones."""
        known = Known(*(np.full(len(track), np.nan) for _ in range(3)))
        height, width = image.shape
        motion = Motion.none((height, width))
        if self._remembered:
            last = self._remembered[-1]
            row, old = last.rows(track)
            row = row[old]
            if len(row) >= _LEAST_FOLLOWED:
                start = self._motions[-1] if self._motions else motion
                motion, then = fit(start, last.points[row], at[old], last.known.picked(row))
                _, change = motion.by_inverse_depth(last.points[row], then.inverse_depth)
                _, inverse_depth = motion.move(last.points[row], then.inverse_depth)
                known.inverse_depth[old], known.still[old] = inverse_depth, then.still
                known.sigma[old] = np.hypot(then.sigma * change, _DRIFT * inverse_depth)
            self._motions = [*self._motions, motion][-2:]
        return known

    def _hide(self, track: IntArray) -> None:
        """Add what was lost since the frame that was remembered last to what is hidden, and move all to the present."""
        if not self._remembered:
            return
        last = self._remembered[-1]
        lost = _lost_with_neighbors(last, np.isin(last.track, track, assume_unique=True), self._hidden.points)
        self._hidden = self._hidden.picked(self._hidden.step >= self._step - self.frames)
        self._hidden.move(self._motions[-1])
        # What came in front may be in the windows of the last frame: points are known in the one before that.
        todo = np.ones(len(lost), np.bool_)
        for age, frame in enumerate(self._remembered):
            row, followed = frame.rows(lost)
            there = np.flatnonzero(followed & todo)
            todo &= ~followed
            # Where something goes that moves by itself is not known.
            there = there[frame.known.still[row[there]] >= _LEAST_STILL]
            row = row[there]
            first = self._step - _INTERVAL * (len(self._remembered) - age)
            new = _Hidden.of(lost[there], self._step - _INTERVAL, first, frame.points[row], frame.known.picked(row))
            for motion in self._motions[age - len(self._remembered) :]:
                new.move(motion)
            self._hidden = self._hidden.joined(new)
        self._views = {
            step: view
            for step, view in self._views.items()
            if (self._hidden.view == step).any() or step >= self._step - 2 * _INTERVAL
        }

    def _remember(self, image: ImageArray, track: IntArray, points: FloatArray, known: Known) -> None:
        order = np.argsort(track)
        track, points = track[order], points[order]
        known = known.picked(order)
        new = ~np.isfinite(known.sigma)
        if (~new).sum() >= _OF_NEAREST:
            _, near = cKDTree(points[~new]).query(points[new], k=_OF_NEAREST)
            around = known.inverse_depth[~new][near]
            known.inverse_depth[new] = np.median(around, axis=1)
            known.sigma[new] = np.maximum(around.std(axis=1), _NEW_SIGMA[0] * known.inverse_depth[new])
            known.still[new] = np.clip(np.median(known.still[~new][near], axis=1), *_NEW_STILL[:2])
        else:
            known.inverse_depth[new], known.sigma[new], known.still[new] = 1.0, _NEW_SIGMA[1], _NEW_STILL[2]
        self._views[self._step] = image
        self._remembered = [*self._remembered, _Remembered(image, track, points, known)][-2:]


def _lost_with_neighbors(last: _Remembered, followed: BoolArray, hidden: FloatArray) -> IntArray:
    """Return the tracks of a frame of which neither they nor most around them are followed any longer.

    Those that were hidden there already, at (n, 2) px, count as neighbors.
    """
    if len(followed) <= _NEIGHBORS or followed.all():
        return np.zeros(0, np.int64)
    lost = np.flatnonzero(~followed)
    gone = np.concatenate((~followed, np.ones(len(hidden), np.bool_)))
    _, near = cKDTree(np.concatenate((last.points, hidden))).query(last.points[lost], k=_NEIGHBORS + 1)
    result: IntArray = last.track[lost[gone[near[:, 1:]].mean(axis=1) >= _HIDDEN_PART]]
    return result


def _search(
    hidden: _Hidden, views: dict[int, ImageArray], image: ImageArray, config: TrackingConfig
) -> tuple[IntArray, FloatArray]:
    """Look for hidden points in the present image: which were found (n,), and where (n, 2) px."""
    nothing = np.zeros(0, np.int64), np.zeros((0, 2))
    last_pixel = np.array(image.shape[::-1]) - 1
    inside = (hidden.points >= config.border_px) & (hidden.points <= last_pixel - config.border_px)
    row = np.flatnonzero(inside.all(axis=1) & _is_moderate(hidden.affine))
    if len(row) < _AGREEING:
        return nothing
    group = hidden.picked(row)
    offset, correlation = _probe(group, views, image, config.patch_px // 2)
    alike = np.flatnonzero(correlation >= _PROBE_CORRELATION)
    agrees = np.zeros(len(row), np.bool_)
    agrees[alike[_agree(group.picked(alike), offset[alike])]] = True
    if agrees.sum() < _AGREEING:
        return nothing
    # What lies among points that were not found is still hidden.
    _, nearest = cKDTree(group.points).query(group.points, k=min(_OF_NEAREST, len(row)))
    promising = np.flatnonzero(agrees[nearest].any(axis=1))
    promising = promising[correlation[promising] >= _LEAST_CORRELATION]
    agreeing = np.flatnonzero(agrees)
    _, near = cKDTree(group.points[agreeing]).query(group.points[promising], k=_AGREEING)
    start = (
        np.where(agrees[promising, None], offset[promising], np.median(offset[agreeing][near], axis=1))
        + group.points[promising]
    )
    there, found = _register_both_ways(group.picked(promising), views, image, start, config)
    return row[promising[found]], there[found]


def _probe(
    group: _Hidden, views: dict[int, ImageArray], image: ImageArray, reach: int
) -> tuple[FloatArray, FloatArray]:
    """Return where patches are best found in an image: (n, 2) px from where they should be, and correlations (n,)."""
    radius = np.clip(np.ceil(_SIGMAS * group.spread()), _LEAST_RADIUS_PX, _LARGEST_RADIUS_PX).astype(np.int64)
    padding = _LARGEST_RADIUS_PX + reach
    padded = cv2.copyMakeBorder(image, padding, padding, padding, padding, cv2.BORDER_REPLICATE)
    patch = _cut(group, views, reach)
    center = np.rint(group.points).astype(np.int64) + padding
    offset, correlation = np.zeros((len(center), 2)), np.full(len(center), -1.0)
    first, end = center - radius - reach, center + radius + reach + 1
    for n in range(len(center)):
        window = padded[first[n, 1] : end[n, 1], first[n, 0] : end[n, 0]]
        _, correlation[n], _, place = cv2.minMaxLoc(cv2.matchTemplate(window, patch[n], cv2.TM_CCOEFF_NORMED))
        offset[n] = place
    return offset + center - padding - radius - group.points, correlation


def _cut(group: _Hidden, views: dict[int, ImageArray], reach: int) -> ImageArray:
    """Return what the patches (N, P, P) should look like at present."""
    side = 2 * reach + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).astype(np.float64)
    source = group.at[:, :, None] + np.linalg.inv(group.affine) @ np.stack((x, y))
    result = np.empty((len(group.at), side * side), np.uint8)
    for view in np.unique(group.view):
        mine = group.view == view
        u, v = source[mine].astype(np.float32).transpose(1, 0, 2)
        result[mine] = cv2.remap(views[int(view)], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return result.reshape(-1, side, side)


def _agree(group: _Hidden, offset: FloatArray) -> BoolArray:
    """Return which of n points have an offset that others near them have, but for what their depth may do to it."""
    if len(offset) < _AGREEING:
        return np.zeros(len(offset), np.bool_)
    _, near = cKDTree(group.points).query(group.points, k=min(_OF_NEAREST, len(offset)))
    along = group.error[:, :, None] * group.error[:, None, :]
    covariance = along[near] + along[:, None] + _AGREEMENT_PX**2 * np.eye(2)
    difference = (offset[near] - offset[:, None])[..., None]
    squares = (difference * np.linalg.solve(covariance, difference)).sum(axis=(2, 3))
    result: BoolArray = (squares <= 1.0).sum(axis=1) >= _AGREEING
    return result


def _register_both_ways(
    group: _Hidden, views: dict[int, ImageArray], image: ImageArray, start: FloatArray, config: TrackingConfig
) -> tuple[FloatArray, BoolArray]:
    """Return where points are found near (n, 2) px, (n, 2) px, and whether (n,) they lead back."""
    place, found = start.copy(), np.zeros(len(start), np.bool_)
    for view in np.unique(group.view):
        mine = np.flatnonzero(group.view == view)
        source, at = views[int(view)], group.at[mine]
        warp = np.concatenate((start[mine], group.affine[mine].reshape(-1, 4)), axis=1)
        index = np.arange(len(mine))
        there, correlation = register(cut_templates(source, at.astype(np.float32), config.patch_px), index, image, warp)
        good = (correlation >= _CORRELATION) & (np.linalg.norm(there[:, :2] - warp[:, :2], axis=1) <= _NEAR_PX)
        good &= _is_moderate(there[:, 2:].reshape(-1, 2, 2))
        ahead = np.flatnonzero(good)
        inverse = np.linalg.inv(there[ahead, 2:].reshape(-1, 2, 2))
        begin = at[ahead] - np.einsum("nij,nj->ni", inverse, there[ahead, :2] - warp[ahead, :2])
        back, correlation = register(
            cut_templates(image, there[ahead, :2].astype(np.float32), config.patch_px), index[: len(ahead)], source,
            np.concatenate((begin, inverse.reshape(-1, 4)), axis=1),
        )  # fmt: skip
        comes_back = np.linalg.norm(back[:, :2] - at[ahead], axis=1) <= config.forward_backward_px
        found[mine[ahead]] = comes_back & (correlation >= _CORRELATION)
        place[mine] = there[:, :2]
    return place, found


def _is_moderate(affine: FloatArray) -> BoolArray:
    """Return (N,) where affine parts (N, 2, 2) neither stretch nor shrink too much."""
    area = np.linalg.det(affine)
    result: BoolArray = (area >= _LEAST_AREA) & (area <= 1 / _LEAST_AREA)
    return result
