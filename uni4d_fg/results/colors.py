"""Colors of points and cameras: by value, by instance."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, Int32Array

STATIC_GRAY = (150, 156, 164)
UNKNOWN_GRAY = (104, 109, 117)
BRIDGED_AMBER = (240, 165, 50)
CURRENT_ORANGE = (255, 122, 26)

_DARKEST = 0.12
"""The color map starts here: its first colors cannot be told from a dark background."""

_PALETTE = np.array(
    [
        (227, 87, 86), (78, 161, 223), (89, 190, 118), (242, 180, 66), (167, 120, 214), (72, 196, 196),
        (236, 128, 190), (164, 190, 76), (206, 138, 92), (120, 140, 240), (240, 120, 60), (60, 160, 120),
    ],
    dtype=np.uint8,
)  # fmt: skip


def instance_colors(instance: Int32Array) -> ImageArray:
    """Return a color per instance id, (..., 3) RGB; 0, the static scene, is gray. Ids keep their color."""
    out: ImageArray = _PALETTE[(np.asarray(instance) - 1) % len(_PALETTE)]
    out[np.asarray(instance) <= 0] = STATIC_GRAY
    return out


def value_range(values: FloatArray) -> tuple[float, float]:
    """Return the range from 0 to the 95th percentile of the finite values, never empty."""
    finite = np.asarray(values)[np.isfinite(values)]
    high = float(np.quantile(finite, 0.95)) if finite.size else 1.0
    return 0.0, high if high > 0.0 else 1.0


def value_colors(values: FloatArray, bounds: tuple[float, float]) -> ImageArray:
    """Return a color per value, (..., 3) RGB: dark violet at the lower bound, yellow at the upper; gray for NaN."""
    # Here, because loading it takes a while, and what has no values needs no colors.
    import matplotlib

    low, high = bounds
    values = np.asarray(values, dtype=np.float64)
    known = ~np.isnan(values)
    level = np.clip((np.where(known, values, low) - low) / (high - low), 0.0, 1.0)
    out: ImageArray = np.rint(
        255.0 * matplotlib.colormaps["plasma"](_DARKEST + (1.0 - _DARKEST) * level)[..., :3]
    ).astype(np.uint8)
    out[~known] = UNKNOWN_GRAY
    return out


def depth_bounds(maps: list[Float32Array]) -> tuple[float, float]:
    """Return the central 96 % of the depths of some maps, never empty; 1 to 2 where there are none."""
    values = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in maps])
    if not values.size:
        return 1.0, 2.0
    low, high = np.percentile(values, [2.0, 98.0]).tolist()
    return float(low), float(max(high, 1.01 * low))


def css_gradient() -> str:
    """Return the colors of :func:`value_colors` as a CSS gradient from left to right."""
    return css_stops(value_colors(np.linspace(0.0, 1.0, 7), (0.0, 1.0)))


def css_stops(colors: ImageArray) -> str:
    """Return colors (N, 3) RGB, evenly spaced, as a CSS gradient from left to right."""
    return "linear-gradient(to right," + ",".join("#{:02x}{:02x}{:02x}".format(*stop) for stop in colors.tolist()) + ")"
