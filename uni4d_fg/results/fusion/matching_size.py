"""The size at which frames are matched, and what is given in pixels of it.

Large frames are matched at half their size, so that thin things and the edges of others are seen, but not at more than
costs seconds a frame. Windows stay as small as they are, or edges would be no sharper.
"""

from __future__ import annotations

from uni4d_fg.config.multiview import MultiviewConfig

USUAL_SIDE = 320
"""Longer side, px, of the maps that lengths in working px are given for."""
_HALF = 0.5
_LARGEST_SMALL_STEP, _LARGEST_STEP = 255, 1000
"""Bounds of the fields: sums of costs along paths have 16 bits."""


def matching_side(image_size: tuple[int, int], config: MultiviewConfig) -> int:
    """Return the longer side, px, at which images (H, W) are matched at most."""
    half = round(_HALF * max(image_size))
    return min(max(half, config.least_side_px), config.longer_side_px)


def times_finer(shape: tuple[int, ...]) -> float:
    """Return how many times as fine as usual a map (h, w) is, and lengths in it as long; at least 1."""
    return max(1.0, max(shape[:2]) / USUAL_SIDE)


def finer_settings(config: MultiviewConfig, finer: float) -> MultiviewConfig:
    """Return settings that do for maps so many times as fine as usual what the given ones do for the usual ones.

    A pixel is the mean of fewer pixels of the image, so that its noise is larger; and a window of as many pixels shows
    less of the scene, on the way through which a surface without texture has more of them to be wrong in.
    """
    return config.model_copy(
        update={
            "image_noise": finer * config.image_noise,
            "small_step_penalty": min(round(finer**2 * config.small_step_penalty), _LARGEST_SMALL_STEP),
            "large_step_penalty": min(round(finer**2 * config.large_step_penalty), _LARGEST_STEP),
            "mask_band_px": round(finer * config.mask_band_px),
        }
    )
