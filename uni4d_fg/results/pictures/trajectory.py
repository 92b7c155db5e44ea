"""The camera path from above and from the side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.ticker import MaxNLocator

from uni4d_fg.arrays import FloatArray, evenly_spread
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory
from uni4d_fg.results.pictures.figure import GRID, INK, MUTED, new_figure, save_figure, upright_axes

_MIN_EXTENT_M = 0.02
_VIEW_ARROWS = 16
_PANELS = ((0.07, 0.09, 0.39, 0.77), (0.53, 0.09, 0.39, 0.77))
_BAR = (0.935, 0.18, 0.012, 0.59)
"""Left, bottom, width and height in parts of the figure."""


def draw_trajectory(
    path: Path, world_T_cam: FloatArray, ground_truth: FloatArray | None = None, *, unit: str = "m"
) -> None:
    """Draw the camera path as PNG: top view and side view, equal axes.

    Args:
        path: The ``.png`` file.
        world_T_cam: (T, 4, 4) estimated camera to world.
        ground_truth: (T, 4, 4) true poses, NaN where unknown; if given, the estimate is first aligned to
            them with Sim(3), and the errors stand in the title.
        unit: Name of the estimate's unit of length; after alignment it is the truth's, meters.

    Raises:
        OutputError: If the file cannot be written.
    """
    poses, truth, title = world_T_cam, None, "Camera path"
    if ground_truth is not None:
        known = np.asarray(np.isfinite(ground_truth).all(axis=(1, 2)))
        if known.sum() > 0:
            truth, unit = ground_truth[known], "m"
            poses = align_trajectories(world_T_cam[known], truth).apply_poses(world_T_cam)
            metrics = evaluate_trajectory(world_T_cam[known], truth)
            title = f"Camera path   ATE {metrics.ate_m:.4f} m"
            if metrics.rpe_rotation_deg is not None:
                title += f",  RPE {metrics.rpe_translation_m:.4f} m, {metrics.rpe_rotation_deg:.3f}°"
            title += f"   (Sim(3), scale {metrics.scale:.3f})"
    axes = upright_axes(poses)
    origin = poses[0, :3, 3]
    estimate = (poses[:, :3, 3] - origin) @ axes.T
    direction = poses[:, :3, 2] @ axes.T
    reference = None if truth is None else (truth[:, :3, 3] - origin) @ axes.T

    # Placed by hand: a layout that is found takes longer than the rest of the picture.
    figure = new_figure(11.0, 5.6, layout=None)
    figure.suptitle(title, color=INK, fontsize=13, x=0.02, y=0.97, ha="left")
    everything = estimate if reference is None else np.concatenate((estimate, reference))
    center = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    half = 0.58 * max(float(np.ptp(everything, axis=0).max()), _MIN_EXTENT_M)
    right, forward, up = (f"{axis} [{unit}]" for axis in ("right", "forward", "up"))
    panels = (("Top view", 0, 1, right, forward), ("Side view", 1, 2, forward, up))
    lines = None
    for column, (name, i, j, label_x, label_y) in enumerate(panels):
        panel = figure.add_axes(_PANELS[column])
        _style(panel, name, label_x, label_y)
        if reference is not None:
            panel.plot(
                reference[:, i], reference[:, j], color=INK, linewidth=1.2, linestyle=(0, (4, 2)), label="ground truth"
            )
        lines = _draw_path(panel, estimate[:, (i, j)], direction[:, (i, j)], 0.09 * half)
        panel.set_xlim(center[i] - half, center[i] + half)
        panel.set_ylim(center[j] - half, center[j] + half)
        panel.set_aspect("equal")
        panel.legend(frameon=False, fontsize=9, labelcolor=INK, loc="best")
    if lines is not None:
        bar = figure.colorbar(lines, cax=figure.add_axes(_BAR))
        bar.set_label("frame", color=INK, fontsize=9)
        bar.ax.tick_params(labelsize=8, colors=MUTED)
        bar.ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        bar.outline.set_visible(False)
    save_figure(path, figure)


def _style(panel: Axes, name: str, label_x: str, label_y: str) -> None:
    panel.set_title(name, loc="left", fontsize=10, color=MUTED)
    panel.set_xlabel(label_x, color=INK, fontsize=9)
    panel.set_ylabel(label_y, color=INK, fontsize=9)
    panel.tick_params(labelsize=8, colors=MUTED)
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=6))
    panel.grid(True, color=GRID, linewidth=0.8)
    panel.set_axisbelow(True)
    for spine in panel.spines.values():
        spine.set_visible(False)


def _draw_path(panel: Axes, points: FloatArray, direction: FloatArray, arrow: float) -> LineCollection | None:
    """Draw one projected path (T, 2), colored by frame, with the viewing direction of some frames."""
    count = len(points)
    chosen = evenly_spread(count, _VIEW_ARROWS)
    rays = np.stack((points[chosen], points[chosen] + arrow * direction[chosen]), axis=1)
    panel.add_collection(LineCollection(list(rays), colors=MUTED, linewidths=0.9, zorder=2))
    panel.plot(points[0, 0], points[0, 1], "o", color=INK, markersize=5, zorder=4, label="first frame")
    if count < 2:
        return None
    segments = np.stack((points[:-1], points[1:]), axis=1)
    lines = LineCollection(list(segments), cmap="viridis", linewidths=2.4, capstyle="round", zorder=3)
    lines.set_array(np.arange(count - 1) + 0.5)
    lines.set_clim(0, count - 1)
    panel.add_collection(lines)
    panel.plot([], [], color="#21918c", linewidth=2.4, label="estimate")
    return lines
