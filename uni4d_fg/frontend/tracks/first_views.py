"""Following points by their first views: steps of Lucas-Kanade, and registration against the view they started in.

A chain of steps adds up the errors of each. Here every few steps a point is put where its first view is found
(:mod:`uni4d_fg.frontend.tracks.registration`); a view that is found needs no check backwards. A point whose first view
is looked for and not found (another scale, a highlight, a neighbor in front) is checked backwards and takes a new first
view where the step led it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.tracks.guided_search import search
from uni4d_fg.frontend.tracks.optical_flow import comes_back
from uni4d_fg.frontend.tracks.registration import cut_templates, is_fast, register

_LARGEST_STRETCH = 2.0
"""A first view that is stretched or shrunk by more is no longer a fair sample of what is seen."""
_IDENTITY = np.array([1.0, 0.0, 0.0, 1.0])


def refines(config: TrackingConfig) -> bool:
    """Return whether points are followed by their first views."""
    return config.refine == "on" or (config.refine == "auto" and is_fast())


@dataclass
class FirstViews:
    """The first views of the N points that are followed, and how they are warped at present."""

    config: TrackingConfig
    templates: Float32Array = field(init=False)
    """(M, P + 2, P + 2) gray levels; some rows are of points that were lost, or free."""
    row: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) of each point among the templates."""
    affine: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    """(N, 4) by rows, from the first view to when it was last found."""
    due: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) steps until it is looked for again."""
    _used: int = 0

    def __post_init__(self) -> None:
        side = 2 * (self.config.patch_px // 2) + 3
        self.templates = np.zeros((0, side, side), np.float32)

    def add(self, image: ImageArray, points: Float32Array) -> None:
        """Append points (N, 2) px that start in an image (H, W) uint8."""
        end = self._used + len(points)
        if end > len(self.templates):
            # Room for as many again: copying what is there is then rare.
            alive = self.templates[self.row]
            self.templates = np.empty((2 * (len(alive) + len(points)), *alive.shape[1:]), np.float32)
            self.templates[: len(alive)] = alive
            self.row, self._used = np.arange(len(alive)), len(alive)
            end = self._used + len(points)
        self.templates[self._used : end] = cut_templates(image, points, self.config.patch_px)
        self.row = np.concatenate((self.row, np.arange(self._used, end)))
        self.affine = np.concatenate((self.affine, np.tile(_IDENTITY, (len(points), 1))))
        # Spread over the steps, so that no frame has all the corrections.
        self.due = np.concatenate((self.due, np.arange(len(points)) % self.config.refine_every))
        self._used = end

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return a copy of what is known of the points, to go on from with :meth:`of_arrays`."""
        return {"templates": self.templates[self.row], "affine": self.affine.copy(), "due": self.due.copy()}

    @classmethod
    def of_arrays(cls, config: TrackingConfig, arrays: Mapping[str, npt.NDArray[Any]]) -> FirstViews:
        """Go on from a copy of what :meth:`to_arrays` returned."""
        views = cls(config, affine=arrays["affine"].copy(), due=arrays["due"].copy())
        views.templates, views._used = arrays["templates"].copy(), len(arrays["templates"])
        views.row = np.arange(views._used)
        return views

    def select(self, keep: BoolArray | IntArray) -> None:
        """Forget all points but those picked by a mask or by indices."""
        self.row, self.affine, self.due = self.row[keep], self.affine[keep], self.due[keep]

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

        def accept(rows: IntArray, moved: Float32Array, expected: Float32Array) -> BoolArray:
            found = np.zeros(len(rows), np.bool_)
            due = self.due[rows] <= 0
            looked = np.flatnonzero(due)
            chosen = rows[looked]
            warp, correlation = register(
                self.templates, self.row[chosen], target, np.concatenate((moved[looked], self.affine[chosen]), axis=1)
            )
            found[looked] = seen = _is_found(warp, correlation, moved[looked], target, self.config)
            refined[chosen[seen]], self.affine[chosen[seen]] = warp[seen, :2], warp[seen, 2:]
            self.due[chosen] = self.config.refine_every
            rest = np.flatnonzero(~found)
            back = rest[comes_back(source, target, points[rows[rest]], moved[rest], expected[rest], self.config)]
            refined[rows[back]] = moved[back]
            anew = back[due[back]]
            self.affine[rows[anew]] = _IDENTITY
            self.templates[self.row[rows[anew]]] = cut_templates(target, moved[anew], self.config.patch_px)
            found[back] = True
            return found

        kept, _ = search(source, target, points, velocity, accept, self.config)
        self.due -= 1
        self.select(kept)
        return kept, refined[kept]


def _is_found(
    warp: FloatArray, correlation: FloatArray, moved: Float32Array, image: ImageArray, config: TrackingConfig
) -> BoolArray:
    """Return (N,) where a first view was found near enough, and looks the same."""
    near = np.linalg.norm(warp[:, :2] - moved, axis=1) <= config.max_refinement_px
    a, b, c, d = warp[:, 2:].T
    # The singular values of a 2 x 2 matrix, from the sum of their squares and their product.
    squares, product = 0.5 * (a * a + b * b + c * c + d * d), a * d - b * c
    root = np.sqrt(np.maximum(squares**2 - product**2, 0.0))
    moderate = (product > 0) & (squares + root <= _LARGEST_STRETCH**2) & (squares - root >= _LARGEST_STRETCH**-2)
    limit = np.array(image.shape[::-1]) - 1 - config.border_px
    inside = (warp[:, :2] >= config.border_px).all(axis=1) & (warp[:, :2] <= limit).all(axis=1)
    found: BoolArray = near & moderate & inside & (correlation >= config.min_patch_correlation)
    return found
