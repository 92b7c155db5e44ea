"""Following points by their first views: steps of Lucas-Kanade, and registration against the view they started in.

A chain of steps adds up the errors of each. Here every few steps a point is put where its first view is found
(:mod:`uni4d_fg.frontend.tracks.registration`); a view that is found needs no check backwards. A point whose first view
is looked for and not found (another scale, a highlight, a neighbor in front) is checked backwards and takes a new first
view where the step led it. Where a turning camera blurs an image, first views are blurred alike before they are looked
for in it (:mod:`uni4d_fg.frontend.tracks.motion_blur`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.tracks.guided_search import search
from uni4d_fg.frontend.tracks.motion_blur import MARGIN_PX, blurred, missing_blur, shift_of_all
from uni4d_fg.frontend.tracks.optical_flow import comes_back, find
from uni4d_fg.frontend.tracks.registration import is_fast, register
from uni4d_fg.frontend.tracks.view_patches import ViewPatches

_LARGEST_STRETCH = 2.0
"""A first view that is stretched or shrunk by more is no longer a fair sample of what is seen."""
_IDENTITY = np.array([1.0, 0.0, 0.0, 1.0])
_SLOW_PX = 5.0
"""A camera that moves the image by less from frame to frame does not blur it by much."""
_PARTS, _FINER = (0.3, 0.5, 0.7, 0.9), 0.1
"""Of the time between two frames that the shutter may be open, and what is tried on either side of the best of them."""
_GROUP_PX = 2.0
"""Vectors of blur are rounded to multiples of this, so that many first views are blurred at once."""
_SAMPLE, _LEAST_SAMPLE = 64, 24
"""Points that the length of blur is measured on."""
_ASTRAY = 0.4
"""Half of them are nearer to where the motion of all leads than this part of it, or it is not theirs."""
_CLEARLY = 0.7
"""Of what correlations miss from 1 without blur, blur must leave less than this."""
_OF_BLUR = 0.1
"""Steps to an image err by up to this part of its blur more, ..."""
_STRONG_PX = 5.0
"""... where that is longer than this."""
_OWN = ("affine", "due", "slack", "blur")


def refines(config: TrackingConfig) -> bool:
    """Return whether points are followed by their first views."""
    return config.refine == "on" or (config.refine == "auto" and is_fast())


@dataclass
class FirstViews:
    """The first views of the N points that are followed, and how they are warped at present."""

    config: TrackingConfig
    patches: ViewPatches = field(init=False)
    """M; some rows are of points that were lost, or free."""
    row: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) of each point among the patches."""
    affine: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    """(N, 4) by rows, from the first view to when it was last found."""
    due: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) steps until it is looked for again."""
    slack: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(N,) px that steps to blurred images may have led each astray since it was last found."""
    blur: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) px, motion blur of the image that the points are in."""
    _used: int = 0

    def __post_init__(self) -> None:
        self.patches = ViewPatches.empty(0, self.config.patch_px)

    def add(self, image: ImageArray, points: Float32Array) -> None:
        """Append points (N, 2) px that start in an image (H, W) uint8."""
        end = self._used + len(points)
        if end > len(self.patches):
            # Room for as many again: copying what is there is then rare.
            alive = self.patches.select(self.row)
            self.patches = ViewPatches.empty(2 * (len(alive) + len(points)), self.config.patch_px)
            self.patches.put(slice(len(alive)), alive)
            self.row, self._used = np.arange(len(alive)), len(alive)
            end = self._used + len(points)
        self.patches.put(slice(self._used, end), self._cut(image, points, self.blur))
        self.row = np.concatenate((self.row, np.arange(self._used, end)))
        self.affine = np.concatenate((self.affine, np.tile(_IDENTITY, (len(points), 1))))
        # Spread over the steps, so that no frame has all the corrections.
        self.due = np.concatenate((self.due, np.arange(len(points)) % self.config.refine_every))
        self.slack = np.concatenate((self.slack, np.zeros(len(points))))
        self._used = end

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return a copy of what is known of the points, to go on from with :meth:`of_arrays`."""
        own = {name: getattr(self, name).copy() for name in _OWN}
        alive = self.patches.select(self.row)
        return own | {f"patch_{part.name}": getattr(alive, part.name) for part in fields(alive)}

    @classmethod
    def of_arrays(cls, config: TrackingConfig, arrays: Mapping[str, npt.NDArray[Any]]) -> FirstViews:
        """Go on from a copy of what :meth:`to_arrays` returned."""
        views = cls(config)
        for name in _OWN:
            setattr(views, name, arrays[name].copy())
        views.patches = ViewPatches(*(arrays[f"patch_{part.name}"].copy() for part in fields(ViewPatches)))
        views._used = len(views.patches)
        views.row = np.arange(views._used)
        return views

    def select(self, keep: BoolArray | IntArray) -> None:
        """Forget all points but those picked by a mask or by indices."""
        self.row, self.affine = self.row[keep], self.affine[keep]
        self.due, self.slack = self.due[keep], self.slack[keep]

    def follow(
        self, source: ImageArray, target: ImageArray, points: Float32Array, velocity: Float32Array
    ) -> tuple[BoolArray, Float32Array]:
        """Move the N points from one gray image to the next, those that are due to where their first views are found.

        Args:
            source: (H, W) uint8, the image in which the points are known.
            target: (H, W) uint8.
            points: (N, 2) px in ``source``.
            velocity: (N, 2) px, the last step of each; NaN where it is not known.

        Returns:
            kept: (N,) True for the M points that passed; the views of the others are forgotten.
            moved: (M, 2) their pixels in ``target``.
        """
        refined = np.empty_like(points)
        blur = self._blur_of(source, target, points)
        strength = float(np.linalg.norm(blur))
        is_strong = strength > _STRONG_PX
        if is_strong:
            self.slack += _OF_BLUR * strength

        def accept(rows: IntArray, moved: Float32Array, expected: Float32Array) -> BoolArray:
            found = np.zeros(len(rows), np.bool_)
            # Steps to blurred images err most: none is left to itself, and what they led astray is sought at once.
            due = (self.due[rows] <= 0) | (self.slack[rows] > 0)
            looked = np.flatnonzero(due)
            chosen = rows[looked]
            warp, seen = self._find(chosen, target, moved[looked], blur)
            found[looked] = seen
            refined[chosen[seen]], self.affine[chosen[seen]] = warp[seen, :2], warp[seen, 2:]
            self.due[chosen], self.slack[chosen[seen]] = self.config.refine_every, 0.0
            rest = np.flatnonzero(~found)
            back = rest[comes_back(source, target, points[rows[rest]], moved[rest], expected[rest], self.config)]
            refined[rows[back]] = moved[back]
            # A blurred image makes a poor first view: the old one is kept, for when it ends.
            anew = back[due[back]] if not is_strong else back[:0]
            self.affine[rows[anew]], self.slack[rows[anew]] = _IDENTITY, 0.0
            self.patches.put(self.row[rows[anew]], self._cut(target, moved[anew], blur))
            found[back] = True
            return found

        kept, _ = search(source, target, points, velocity, accept, self.config)
        self.due -= 1
        self.select(kept)
        self.blur = blur
        return kept, refined[kept]

    def _cut(self, image: ImageArray, points: Float32Array, blur: FloatArray) -> ViewPatches:
        return ViewPatches.cut(image, points, self.config.patch_px, blur)

    def _find(
        self, points: IntArray, image: ImageArray, start: Float32Array, blur: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Look for the first views of some points (n,) from (n, 2) px on in an image with motion blur (2,) px.

        What moves with the camera, and is sharp where the rest is blurred, is looked for as if there were no blur.

        Returns:
            The warps (n, 6), and whether each was found near enough and looks the same, (n,).
        """
        warp, correlation = self._register(points, image, start, blur)
        farthest = self.config.max_refinement_px + self.slack[points]
        found = _is_found(warp, correlation, start, image, farthest, self.config)
        again = np.flatnonzero(~found) if blur.any() or self.patches.blur[self.row[points]].any() else found[:0]
        if len(again):
            plain, correlation = self._register_as_cut(points[again], image, start[again])
            also = _is_found(plain, correlation, start[again], image, farthest[again], self.config)
            warp[again[also]], found[again[also]] = plain[also], True
        return warp, found

    def _register(
        self, points: IntArray, image: ImageArray, start: Float32Array, blur: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Find the first views of points (n,) with equal blur; as :func:`register`."""
        rows = self.row[points]
        own = self.patches.blur[rows].astype(np.float64)
        of_view, of_image = missing_blur(own, blur[None]), missing_blur(blur[None], own)
        if not of_view.any() and not of_image.any():
            return self._register_as_cut(points, image, start)
        warp, correlation = np.zeros((len(points), 6)), np.zeros(len(points))
        vectors = _GROUP_PX * np.rint(np.concatenate((of_view, of_image), axis=1) / _GROUP_PX)
        kinds, kind = np.unique(vectors, axis=0, return_inverse=True)
        for number, (view, frame) in enumerate(kinds.reshape(-1, 2, 2)):
            mine = np.flatnonzero(kind.reshape(-1) == number)
            templates, at = self.patches.template, rows[mine]
            if view.any():
                templates, at = self.patches.blurred(at, view), np.arange(len(mine))
            seen = blurred(image, frame) if frame.any() else image
            begun: FloatArray = np.concatenate((start[mine], self.affine[points[mine]]), axis=1)
            warp[mine], correlation[mine] = register(templates, at, seen, begun)
        return warp, correlation

    def _register_as_cut(
        self, points: IntArray, image: ImageArray, start: Float32Array
    ) -> tuple[FloatArray, FloatArray]:
        begun: FloatArray = np.concatenate((start, self.affine[points]), axis=1)
        return register(self.patches.template, self.row[points], image, begun)

    def _blur_of(self, source: ImageArray, target: ImageArray, points: Float32Array) -> FloatArray:
        """Return the motion blur (2,) px of the target image, zero for a sharp one.

        It is the one, of those that a shutter can make of the motion of all, under which first views look most like
        what is seen, if they look so clearly more than as they are.
        """
        if not self.config.match_blur:
            return np.zeros(2)
        shift = shift_of_all(source, target)
        if np.linalg.norm(shift) < _SLOW_PX:
            return np.zeros(2)
        sharp = np.flatnonzero(~self.patches.blur[self.row].any(axis=1))
        some = sharp[:: max(len(sharp) // _SAMPLE, 1)]
        expected = points[some] + shift.astype(np.float32)
        moved, found = find(source, target, points[some], expected, self.config)
        astray = np.linalg.norm(moved - expected, axis=1)[found]
        some, moved = some[found], moved[found]
        # What passes before a camera at rest may be what most of two images share, and is no blur of the others.
        if len(some) < _LEAST_SAMPLE or np.median(astray) > _ASTRAY * np.linalg.norm(shift):
            return np.zeros(2)

        def unlike(part: float) -> float:
            return 1.0 - float(np.median(self._register(some, target, moved, part * shift)[1]))

        longest = min(1.0, 2 * MARGIN_PX / float(np.linalg.norm(shift)))
        first, *others = (part * longest for part in _PARTS)
        plain, tried = unlike(0.0), {first: unlike(first)}
        if tried[first] >= plain:  # most images end here
            return np.zeros(2)
        tried |= {part: unlike(part) for part in others}
        best = min(tried, key=tried.__getitem__)
        if tried[best] > min(_CLEARLY * plain, 1.0 - self.config.min_patch_correlation):
            return np.zeros(2)
        tried |= {best + change: unlike(best + change) for change in (-_FINER * longest, _FINER * longest)}
        return np.asarray(min(tried, key=tried.__getitem__) * shift)


def _is_found(
    warp: FloatArray,
    correlation: FloatArray,
    moved: Float32Array,
    image: ImageArray,
    farthest_px: FloatArray,
    config: TrackingConfig,
) -> BoolArray:
    """Return (N,) where a first view was found near enough, and looks the same."""
    near = np.linalg.norm(warp[:, :2] - moved, axis=1) <= farthest_px
    a, b, c, d = warp[:, 2:].T
    # The singular values of a 2 x 2 matrix, from the sum of their squares and their product.
    squares, product = 0.5 * (a * a + b * b + c * c + d * d), a * d - b * c
    root = np.sqrt(np.maximum(squares**2 - product**2, 0.0))
    moderate = (product > 0) & (squares + root <= _LARGEST_STRETCH**2) & (squares - root >= _LARGEST_STRETCH**-2)
    limit = np.array(image.shape[::-1]) - 1 - config.border_px
    inside = (warp[:, :2] >= config.border_px).all(axis=1) & (warp[:, :2] <= limit).all(axis=1)
    found: BoolArray = near & moderate & inside & (correlation >= config.min_patch_correlation)
    return found
