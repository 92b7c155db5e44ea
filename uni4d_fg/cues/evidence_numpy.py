"""The comparison of ``cpp_factors/src/moved_evidence.cpp`` in NumPy: what it must give, and what runs without it."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array
from uni4d_fg.cues.guided_filter import sum_colors

_MEDIAN_OF_SQUARE = 0.455
"""Of the square of a standard normal variable."""


def moved_evidence_numpy(
    color: Float32Array,
    seen: Float32Array,
    u: Float32Array,
    v: Float32Array,
    du: Float32Array,
    dv: Float32Array,
    z: Float32Array,
    sigma_depth: Float32Array,
    gxx: Float32Array,
    gxy: Float32Array,
    gyy: Float32Array,
    variance: Float32Array,
    contrast: Float32Array,
    texture: Float32Array | None,
    nearest: Float32Array,
    *,
    patch: int,
    shadow_window: int,
    deepest_shadow: float,
    lit: float,
    nearer: float,
    limits: tuple[float, float],
    step: int,
) -> Float32Array:
    """Return the log odds (h, w) that pixels have moved, see :mod:`uni4d_fg.cues.appearance`; 0 where nothing is known.

    Args:
        color: (h, w, 3) gray levels.
        seen: (h, w, 3) those of the other frame where a static scene has the pixels.
        u: Columns (h, w) and
        v: rows (h, w) of these places, px ...
        du: ... and their change
        dv: per unit of log depth, px.
        z: (h, w) predicted depth.
        sigma_depth: (h, w) standard deviation of log depth.
        gxx: (h, w) products of gradients, summed over colors,
        gxy: likewise, and
        gyy: likewise.
        variance: (h, w) of a difference of colors but for what an error of depth does.
        contrast: (h, w) variance of the colors around.
        texture: (h, w) the same, where a pixel may be one of the other frame in a shadow; None for not.
        nearest: (h, w) least depth around each pixel of the other frame, infinite where none is known.
        patch: Side of the window over which squares are averaged, px.
        shadow_window: Side of that over which a shadow is even, px.
        deepest_shadow: Least part of its color that something has in one.
        lit: From this part on it is in none.
        nearer: What is nearer than this part of the predicted depth hides it.
        limits: Of the result.
        step: Medians are those of every so many pixels in x and y.
    """
    height, width = contrast.shape
    inside = (u >= 1) & (u <= width - 2) & (v >= 1) & (v <= height - 2)
    sampled = (slice(None, None, step),) * 2
    some = inside[sampled]
    if not some.any():
        return np.zeros((height, width), np.float32)
    difference = color - seen
    difference -= np.median(difference[sampled][some], axis=0)  # exposure
    squared = _squared(difference, patch)

    x, y = sigma_depth * du, sigma_depth * dv
    total = np.asarray(variance + (x * x * gxx + 2 * x * y * gxy + y * y * gyy), np.float32)
    # Blur and noise of this pair of frames: most of the image is static.
    total *= max(1.0, float(np.median((squared[sampled] / total[sampled])[some])) / _MEDIAN_OF_SQUARE)
    evidence = _log_odds(squared, total, contrast)
    if texture is not None:
        rest, gain = _without_shadow(color, difference, shadow_window, deepest_shadow)
        shaded = (gain < lit) & (2 * texture > total)
        in_shadow = _log_odds(_squared(rest, patch), total, texture)
        evidence = np.where(shaded, np.minimum(evidence, in_shadow), evidence)

    there = cv2.remap(nearest, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    hidden = there < np.float32(nearer) * z
    return np.where(inside & ~hidden, np.clip(evidence, *limits), 0).astype(np.float32)


def _squared(difference: Float32Array, patch: int) -> Float32Array:
    """Return the mean square (h, w) around of a difference of colors (h, w, 3), summed over them."""
    return np.asarray(cv2.boxFilter(sum_colors(difference * difference), -1, (patch, patch)), np.float32)


def _log_odds(squared: Float32Array, variance: Float32Array, contrast: Float32Array) -> Float32Array:
    wider = variance + 2 * contrast
    return np.asarray(0.5 * (squared / variance - squared / wider - np.log(wider / variance)), np.float32)


def _without_shadow(
    color: Float32Array, difference: Float32Array, window: int, deepest: float
) -> tuple[Float32Array, Float32Array]:
    """Return what a shadow leaves of a difference of colors (h, w, 3), and its gain (h, w)."""
    even = color - difference
    common, power = (cv2.boxFilter(sum_colors(even * other), -1, (window, window)) for other in (color, even))
    gain = common / np.maximum(power, np.float32(1.0))
    return color - np.clip(gain, np.float32(deepest), np.float32(1.0))[..., None] * even, gain
