"""The pictures of the page: depth as color, and residuals drawn on frames."""

from __future__ import annotations

import cv2
import matplotlib
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from uni4d_fg.results.colors import css_stops, value_colors
from uni4d_fg.results.pictures.figure import thumbnail

_MISSING = (150, 155, 162)
_MIN_MAP_WIDTH = 480


def depth_picture(depth: Float32Array, bounds: tuple[float, float], width: int) -> ImageArray:
    """Return depth (H, W) as colors, logarithmic, near red and far blue, missing gray."""
    height = max(1, round(depth.shape[0] * width / depth.shape[1]))
    if depth.shape[1] > width:
        depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
    known = np.isfinite(depth) & (depth > 0)
    level = np.log(np.where(known, depth, bounds[0]) / bounds[0]) / np.log(bounds[1] / bounds[0])
    out = np.rint(255.0 * matplotlib.colormaps["turbo_r"](np.clip(level, 0.0, 1.0))[..., :3]).astype(np.uint8)
    out[~known] = _MISSING
    return np.asarray(out)


def depth_gradient() -> str:
    """Return the colors of :func:`depth_picture` from near to far as a CSS gradient."""
    return css_stops(np.rint(255.0 * matplotlib.colormaps["turbo_r"](np.linspace(0.0, 1.0, 9))[:, :3]).astype(np.uint8))


def residual_picture(
    image: ImageArray,
    uv: FloatArray,
    norm: FloatArray,
    is_dynamic: BoolArray,
    unused_uv: FloatArray,
    bounds: tuple[float, float],
    width: int,
) -> ImageArray:
    """Draw the observations of a frame on its image, darkened and without color.

    Static points are discs, moving ones squares, colored by residual; tracks that were not used are gray crosses.

    Args:
        image: (H, W, 3) RGB.
        uv: (N, 2) observed pixels.
        norm: (N,) residuals, px.
        is_dynamic: (N,).
        unused_uv: (U, 2) pixels of tracks without a point.
        bounds: Residuals at the ends of the colors, px.
        width: Largest width of the result, px; small images are enlarged.
    """
    small = thumbnail(image, width)
    if small.shape[1] < _MIN_MAP_WIDTH:
        # Marks have a size of their own, which would cover a small image.
        height = round(small.shape[0] * _MIN_MAP_WIDTH / small.shape[1])
        small = np.asarray(cv2.resize(small, (_MIN_MAP_WIDTH, height), interpolation=cv2.INTER_LINEAR))
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    canvas = np.repeat((0.55 * gray).astype(np.uint8)[..., None], 3, axis=2)
    scale = small.shape[1] / image.shape[1]

    # Pixel centers are integers in both images, which shifts them by half a pixel each way.
    def place(points: FloatArray) -> list[tuple[int, int]]:
        return [(round(x), round(y)) for x, y in ((points + 0.5) * scale - 0.5).tolist()]

    for x, y in place(unused_uv):
        cv2.drawMarker(canvas, (x, y), (175, 180, 186), cv2.MARKER_TILTED_CROSS, 5, 1)
    colors = value_colors(norm, bounds).tolist()
    order = np.argsort(norm)
    places = place(uv)
    for index in order.tolist():
        x, y = places[index]
        if is_dynamic[index]:
            cv2.rectangle(canvas, (x - 2, y - 2), (x + 2, y + 2), colors[index], -1)
        else:
            cv2.circle(canvas, (x, y), 2, colors[index], -1, cv2.LINE_AA)
    return canvas
