"""Gray levels around points, as they are and with what is needed to blur them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.frontend.tracks.motion_blur import MARGIN_PX, blurred_patches
from uni4d_fg.frontend.tracks.registration import between_pixels, cut_levels, templates_of


@dataclass
class ViewPatches:
    """Patches of side P around M points, each of an image that may be blurred itself."""

    template: Float32Array
    """(M, P + 2, P + 2) of :func:`~uni4d_fg.frontend.tracks.registration.cut_templates`."""
    wide: ImageArray
    """(M, S, S) uint8, whole pixels with a margin of :data:`MARGIN_PX`; S = P + 3 + 2 MARGIN_PX."""
    fraction: Float32Array
    """(M, 2) px of the point past the pixel that is in the middle of ``wide``."""
    blur: Float32Array
    """(M, 2) px, motion blur of the image."""

    @classmethod
    def empty(cls, count: int, patch_px: int) -> ViewPatches:
        """Return room for patches."""
        inner = 2 * (patch_px // 2) + 3
        wide = inner + 1 + 2 * MARGIN_PX
        return cls(
            np.zeros((count, inner, inner), np.float32), np.zeros((count, wide, wide), np.uint8),
            np.zeros((count, 2), np.float32), np.zeros((count, 2), np.float32),
        )  # fmt: skip

    @classmethod
    def cut(cls, image: ImageArray, points: Float32Array, patch_px: int, blur: FloatArray) -> ViewPatches:
        """Return the patches around points (N, 2) px of a gray image (H, W) uint8 with motion blur (2,) px."""
        wide, whole = cut_levels(image, points, patch_px // 2 + 1 + MARGIN_PX)
        inner = slice(MARGIN_PX, wide.shape[1] - MARGIN_PX)
        return cls(
            templates_of(wide[:, inner, inner], points, whole, image.shape[:2]), wide, points - whole,
            np.tile(np.asarray(blur, np.float32), (len(points), 1)),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.template)

    def select(self, rows: IntArray) -> ViewPatches:
        """Return a copy of the patches at rows (N,)."""
        return ViewPatches(*(getattr(self, field.name)[rows] for field in fields(self)))

    def put(self, rows: IntArray | slice, patches: ViewPatches) -> None:
        """Replace the patches at rows (N,)."""
        for field in fields(self):
            getattr(self, field.name)[rows] = getattr(patches, field.name)

    def blurred(self, rows: IntArray, blur: FloatArray) -> Float32Array:
        """Return the templates at rows (N,), blurred by a further vector (2,) px."""
        templates = between_pixels(blurred_patches(self.wide[rows], blur), self.fraction[rows])
        templates[np.isnan(self.template[rows])] = np.nan
        return templates
