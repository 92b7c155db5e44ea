"""Pictures of a comparison: energy against time, paths and depth of all solvers side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.pipeline.compare.benchmark import Benchmark
from uni4d_fg.results.pictures.figure import (
    GRID,
    INK,
    MUTED,
    new_figure,
    save_figure,
    spread_frames,
    upright_axes,
)

_COLORS = ("#0b6e4f", "#c8553d", "#3d5a98", "#b58900", "#7b4fa3")
_DEPTH_FRAMES = 4


def draw_energies(path: Path, benchmarks: list[Benchmark], title: str) -> None:
    """Draw the exact energy against wall time, both logarithmic, one panel per benchmark; PNG.

    Raises:
        OutputError: If the file cannot be written.
    """
    columns = min(3, max(len(benchmarks), 1))
    rows = -(-len(benchmarks) // columns)
    figure = new_figure(4.2 * columns, 3.4 * rows)
    figure.suptitle(title, color=INK, fontsize=12, x=0.02, ha="left")
    for index, benchmark in enumerate(benchmarks):
        panel = figure.add_subplot(rows, columns, index + 1)
        style_panel(panel, f"{benchmark.kind} from {benchmark.start}", "wall time [s]", "exact energy")
        for color, (name, performance) in zip(_COLORS * 9, benchmark.performances.items(), strict=False):
            curve = np.array(performance.curve)
            start = np.array([[curve[1:, 0].min(initial=1e-3), curve[0, 1]]])
            seconds, energy = np.concatenate((start, curve[1:])).T
            panel.plot(seconds, energy, color=color, linewidth=1.8, label=name, drawstyle="steps-post")
            panel.plot(seconds[-1], energy[-1], "o", color=color, markersize=4)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.legend(frameon=False, fontsize=8, labelcolor=INK)
    save_figure(path, figure)


def draw_paths(path: Path, poses: Mapping[str, FloatArray], truth: FloatArray | None) -> None:
    """Draw the camera paths (T, 4, 4) of all solvers from above, aligned to the truth or to the first; PNG.

    Raises:
        OutputError: If the file cannot be written.
    """
    reference = next(iter(poses.values())) if truth is None else truth
    known = np.asarray(np.isfinite(reference).all(axis=(1, 2)))
    axes, origin = upright_axes(reference[known]), reference[known][0, :3, 3]
    figure = new_figure(11.0, 5.4)
    panels = [figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)]
    for panel, (name, i, j) in zip(panels, (("Top view", 0, 1), ("Side view", 1, 2)), strict=True):
        style_panel(panel, name, ("right [m]", "forward [m]")[i], ("forward [m]", "up [m]")[j - 1])
        if truth is not None:
            flat = (truth[known][:, :3, 3] - origin) @ axes.T
            panel.plot(flat[:, i], flat[:, j], color=INK, linewidth=1.2, linestyle=(0, (4, 2)), label="ground truth")
        for color, (solver, estimate) in zip(_COLORS * 9, poses.items(), strict=False):
            aligned = align_trajectories(estimate[known], reference[known]).apply_poses(estimate)
            flat = (aligned[:, :3, 3] - origin) @ axes.T
            panel.plot(flat[:, i], flat[:, j], color=color, linewidth=1.8, label=solver)
        panel.set_aspect("equal", adjustable="datalim")
        panel.legend(frameon=False, fontsize=9, labelcolor=INK)
    save_figure(path, figure)


def draw_depths(path: Path, images: FrameSource[ImageArray], rows: Mapping[str, FrameSource[Float32Array]]) -> None:
    """Draw some frames as a strip: image, then depth row by row in the colors of the first; PNG.

    Args:
        path: The file.
        images: T images (H, W, 3), RGB.
        rows: T depth maps each, of any size, by name.

    Raises:
        InputError: If a frame cannot be read.
        OutputError: If the file cannot be written.
    """
    frames = spread_frames(len(images), _DEPTH_FRAMES)
    height, width = images[0].shape[:2]
    reference = next(iter(rows.values()))
    figure = new_figure(2.6 * len(frames) + 0.6, (2.6 * height / width + 0.12) * (len(rows) + 1))
    grid = figure.subplots(len(rows) + 1, len(frames), squeeze=False)
    for column, frame in enumerate(frames):
        first = np.asarray(reference[frame])
        good = first[np.isfinite(first) & (first > 0)]
        low, high = np.quantile(good, (0.02, 0.98)) if good.size else (0.0, 1.0)
        grid[0, column].imshow(images[frame])
        grid[0, column].set_title(f"frame {frame}", fontsize=9, color=MUTED)
        for row, source in enumerate(rows.values(), start=1):
            depth = np.asarray(source[frame], dtype=np.float64)
            shown = np.where(depth > 0, depth, np.nan)
            grid[row, column].imshow(shown, cmap="viridis_r", vmin=low, vmax=high)
    for row, name in enumerate(("image", *rows)):
        grid[row, 0].set_ylabel(name, fontsize=9, color=INK)
    for panel in grid.flat:
        panel.set_xticks([])
        panel.set_yticks([])
    save_figure(path, figure)


def style_panel(panel: Axes, title: str, label_x: str, label_y: str) -> None:
    """Give a panel the look of all figures."""
    panel.set_title(title, loc="left", fontsize=10, color=MUTED)
    panel.set_xlabel(label_x, color=INK, fontsize=9)
    panel.set_ylabel(label_y, color=INK, fontsize=9)
    panel.tick_params(which="both", labelsize=8, colors=MUTED)
    panel.grid(True, which="major", color=GRID, linewidth=0.8)
    panel.set_axisbelow(True)
    for spine in panel.spines.values():
        spine.set_visible(False)
