"""Image, depth cue and fused depth of a few frames, one above the other."""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.results.colors import depth_bounds
from uni4d_fg.results.pictures.figure import INK, MUTED, Collage, spread_frames

_MISSING = "#b9bdc3"
_MAX_COLUMN_PX = 480
"""Larger maps are thinned before they are painted ..."""
_COLUMN_PX = 300
"""... and brought to this width."""
_GAP_PX = 4
_LEFT_PX, _RIGHT_PX, _TOP_PX, _BOTTOM_PX = 36, 108, 36, 12


def draw_depth_strip(
    path: Path,
    images: FrameSource[ImageArray],
    cue: FrameSource[Float32Array],
    fused: FrameSource[Float32Array],
    *,
    columns: int = 5,
    unit: str = "m",
) -> None:
    """Draw a few frames as PNG, in columns: image, depth cue, fused depth, and the change between the two.

    Cue and fused depth share one color range (the central 96 % of the depths shown); missing depth is gray.

    Args:
        path: The ``.png`` file.
        images: T images (H, W, 3), RGB.
        cue: T maps (H, W), meters, NaN where missing.
        fused: T maps (H, W), meters, NaN where missing.
        columns: Number of frames shown, evenly spread.
        unit: Name of the unit of depth.

    Raises:
        OutputError: If the file cannot be written.
    """
    frames = spread_frames(len(images), columns)
    shown_images = [_column(images[t]) for t in frames]
    shown_cue = [_positive(_thin(cue[t])) for t in frames]
    shown_fused = [_positive(_thin(fused[t])) for t in frames]
    change = [100.0 * (f / c - 1.0) for c, f in zip(shown_cue, shown_fused, strict=True)]
    low, high = depth_bounds(shown_cue + shown_fused)
    depth_norm = LogNorm(low, high, clip=True)
    reach = _change_reach(change)
    colors = matplotlib.colormaps["turbo_r"].with_extremes(bad=_MISSING)
    signed = matplotlib.colormaps["RdBu_r"].with_extremes(bad=_MISSING)

    def painted_depth(depth: np.ndarray) -> ImageArray:
        return _painted(np.log(depth / low) / np.log(high / low), colors)

    rows = [
        shown_images,
        [painted_depth(depth) for depth in shown_cue],
        [painted_depth(depth) for depth in shown_fused],
        [_painted(0.5 + 0.5 * ratio / reach, signed) for ratio in change],
    ]
    collage = _mosaic(rows, [f"frame {frame}" for frame in frames], ("image", "depth cue", "fused depth", "change"))
    bar = _color_bar(collage.figure, (1, 3), ScalarMappable(depth_norm, colors), f"depth [{unit}]")
    _label_depths(bar, depth_norm)
    _color_bar(collage.figure, (3, 4), ScalarMappable(TwoSlopeNorm(0.0, -reach, reach), signed), "fused / cue [%]")
    collage.save(path)


def _painted(values: np.ndarray, colors: Colormap) -> ImageArray:
    """Return the colors (h, w, 3) of numbers from 0 to 1, as wide as a column; NaN is missing."""
    painted = np.asarray(colors(np.clip(values, 0.0, 1.0), bytes=True))[..., :3]
    return _column(np.ascontiguousarray(painted))


def _column(image: ImageArray) -> ImageArray:
    """Return an image as wide as a column."""
    height, width = image.shape[:2]
    size = (_COLUMN_PX, max(1, round(height * _COLUMN_PX / width)))
    interpolation = cv2.INTER_AREA if width > _COLUMN_PX else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), dtype=np.uint8)


def _mosaic(rows: list[list[ImageArray]], titles: list[str], names: tuple[str, ...]) -> Collage:
    """Return pictures of one size in rows, titles above the columns and names before the rows."""
    height, width = rows[0][0].shape[:2]
    step_x, step_y = width + _GAP_PX, height + _GAP_PX
    mosaic = np.full((len(rows) * step_y - _GAP_PX, len(titles) * step_x - _GAP_PX, 3), 255, dtype=np.uint8)
    for row, pictures in enumerate(rows):
        for column, image in enumerate(pictures):
            mosaic[row * step_y : row * step_y + height, column * step_x : column * step_x + width] = image
    collage = Collage(_LEFT_PX + mosaic.shape[1] + _RIGHT_PX, _TOP_PX + mosaic.shape[0] + _BOTTOM_PX)
    panel = collage.add_picture(mosaic, _LEFT_PX, _TOP_PX)
    for column, title in enumerate(titles):
        panel.text(column * step_x + width / 2, -0.03 * height, title, fontsize=9, color=MUTED, ha="center")
    for row, name in enumerate(names):
        panel.text(
            -0.02 * width, row * step_y + height / 2, name, fontsize=10, color=INK, ha="right", va="center", rotation=90
        )
    return collage


def _color_bar(figure: Figure, rows: tuple[int, int], colors: ScalarMappable, label: str) -> Axes:
    """Add a color bar to the right of the rows from the first to before the last of four."""
    panel = figure.axes[0].get_position()
    row = panel.height / 4
    bottom, height = panel.y1 - rows[1] * row, (rows[1] - rows[0]) * row
    width = figure.get_figwidth()
    axes = figure.add_axes((panel.x1 + 0.1 / width, bottom + 0.05 * row, 0.12 / width, height - 0.1 * row))
    bar = figure.colorbar(colors, cax=axes)
    bar.set_label(label, fontsize=9, color=INK)
    axes.tick_params(labelsize=8, colors=MUTED)
    return axes


def _thin(array: np.ndarray) -> np.ndarray:
    """Take every n-th pixel of a large image."""
    step = max(1, int(np.ceil(array.shape[1] / _MAX_COLUMN_PX)))
    return array[::step, ::step]


def _positive(depth: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan)


def _change_reach(maps: list[np.ndarray]) -> float:
    """Return the change, percent, from which on colors stay the same."""
    values = np.concatenate([np.abs(change[np.isfinite(change)]) for change in maps])
    reach = float(np.percentile(values, 98.0)) if len(values) else 1.0
    return max(reach, 0.5)


def _label_depths(axis: Axes, norm: LogNorm) -> None:
    """Put round numbers on a logarithmic color bar."""
    low, high = float(norm.vmin or 1.0), float(norm.vmax or 2.0)
    inside: list[float] = []
    for mantissas in (
        (1.0, 2.0, 5.0),
        (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
        (1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0),
    ):
        inside = [m * 10.0**e for e in range(-3, 4) for m in mantissas if low <= m * 10.0**e <= high]
        if len(inside) >= 4:
            break
    axis.yaxis.set_major_locator(FixedLocator(inside if len(inside) > 1 else [low, high]))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
