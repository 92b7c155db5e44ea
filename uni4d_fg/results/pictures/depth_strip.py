"""Image, depth cue and fused depth of a few frames, one above the other."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, TwoSlopeNorm
from matplotlib.image import AxesImage
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.results.colors import depth_bounds
from uni4d_fg.results.pictures.figure import INK, MUTED, new_figure, save_figure, spread_frames

_MISSING = "#b9bdc3"
_MAX_COLUMN_PX = 480


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
    shown_images = [_thin(images[t]) for t in frames]
    shown_cue = [_positive(_thin(cue[t])) for t in frames]
    shown_fused = [_positive(_thin(fused[t])) for t in frames]
    change = [100.0 * (f / c - 1.0) for c, f in zip(shown_cue, shown_fused, strict=True)]
    height, width = shown_images[0].shape[:2]
    column_in = 2.5
    figure = new_figure(column_in * len(frames) + 1.2, 4 * column_in * height / width + 0.5)
    grid = np.asarray(figure.subplots(4, len(frames), squeeze=False))
    low, high = depth_bounds(shown_cue + shown_fused)
    depth_norm = LogNorm(low, high, clip=True)
    change_norm = _change_range(change)
    colors = matplotlib.colormaps["turbo_r"].with_extremes(bad=_MISSING)
    signed = matplotlib.colormaps["RdBu_r"].with_extremes(bad=_MISSING)

    shown: list[AxesImage] = []
    for column, frame in enumerate(frames):
        grid[0, column].set_title(f"frame {frame}", fontsize=9, color=MUTED)
        grid[0, column].imshow(shown_images[column])
        grid[1, column].imshow(shown_cue[column], cmap=colors, norm=depth_norm, interpolation="nearest")
        depth = grid[2, column].imshow(shown_fused[column], cmap=colors, norm=depth_norm, interpolation="nearest")
        ratio = grid[3, column].imshow(change[column], cmap=signed, norm=change_norm, interpolation="nearest")
        shown = [depth, ratio]
    for row, name in enumerate(("image", "depth cue", "fused depth", "change")):
        for panel in grid[row]:
            _bare(panel)
        grid[row, 0].set_ylabel(name, fontsize=10, color=INK)
    bar = figure.colorbar(shown[0], ax=list(grid[1:3].ravel()), pad=0.01, aspect=30)
    _label_depths(bar.ax, depth_norm)
    bar.set_label(f"depth [{unit}]", fontsize=9, color=INK)
    bar_change = figure.colorbar(shown[1], ax=list(grid[3]), pad=0.01, aspect=15)
    bar_change.set_label("fused / cue [%]", fontsize=9, color=INK)
    for axis in (bar.ax, bar_change.ax):
        axis.tick_params(labelsize=8, colors=MUTED)
    save_figure(path, figure)


def _thin(array: np.ndarray) -> np.ndarray:
    """Take every n-th pixel of a large image."""
    step = max(1, int(np.ceil(array.shape[1] / _MAX_COLUMN_PX)))
    return array[::step, ::step]


def _positive(depth: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan)


def _change_range(maps: list[np.ndarray]) -> Normalize:
    values = np.concatenate([np.abs(change[np.isfinite(change)]) for change in maps])
    reach = float(np.percentile(values, 98.0)) if len(values) else 1.0
    reach = max(reach, 0.5)
    return TwoSlopeNorm(0.0, -reach, reach)


def _label_depths(axis: Axes, norm: LogNorm) -> None:
    """Put round numbers on a logarithmic color bar."""
    low, high = float(norm.vmin or 1.0), float(norm.vmax or 2.0)
    inside: list[float] = []
    for mantissas in ((1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0), tuple(np.arange(1.0, 10.0, 0.25))):
        inside = [m * 10.0**e for e in range(-3, 4) for m in mantissas if low <= m * 10.0**e <= high]
        if len(inside) >= 4:
            break
    axis.yaxis.set_major_locator(FixedLocator(inside if len(inside) > 1 else [low, high]))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))


def _bare(panel: Axes) -> None:
    panel.set_xticks([])
    panel.set_yticks([])
    for spine in panel.spines.values():
        spine.set_visible(False)
