"""Views of the 4D cloud at a few times, with the trails of the moving points and the cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patheffects import Normal, Stroke
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, FloatArray, ImageArray, evenly_spread
from uni4d_fg.optim.threads import map_in_order, thread_count
from uni4d_fg.results.pictures.figure import INK, MUTED, Collage, spread_frames, upright_axes
from uni4d_fg.results.pictures.splatting import View, look_at, render
from uni4d_fg.slam.reconstruction import Reconstruction

_BACKGROUND = (247, 248, 250)
_PANEL = (450, 640)
"""Height and width, px."""
_GAP_PX, _TITLE_PX = 10, 30
_ELEVATION_DEG = 22.0
_MARGIN = 0.04
_OUTSIDE = 0.15
"""Percent of a cloud's points beyond each side of the picture: strays, which would make the rest small."""
_MAX_STATIC_POINTS = 400_000
_MAX_TRAILS = 160
_HIDDEN_BY = 1.06


def draw_scene(
    path: Path,
    reconstruction: Reconstruction,
    static: tuple[FloatArray, ImageArray],
    dynamic: Callable[[int], tuple[FloatArray, ImageArray]],
    *,
    panels: int = 4,
    trail_frames: int = 12,
) -> None:
    """Render the cloud as PNG, seen from above and behind the cameras, at a few times.

    Args:
        path: The ``.png`` file.
        reconstruction: Cameras and dynamic trajectories.
        static: Points (N, 3), meters, and RGB (N, 3) of the static cloud.
        dynamic: Returns the same for the moving instances of a frame.
        panels: Number of times shown, evenly spread over the frames in which something moves.
        trail_frames: Length of the moving points' trails, frames.

    Raises:
        OutputError: If the file cannot be written.
    """
    points, colors = _thin(*static)
    view = _view(reconstruction, points)
    size = _sizes(points)
    frames = times_of_the_subject(reconstruction.dynamic_observed, panels)
    trails, trail_colors = _trails(reconstruction)
    columns = 2 if len(frames) > 1 else 1
    rows = -(-len(frames) // columns)
    height, width = view.image_size
    collage = Collage(columns * (width + _GAP_PX) + _GAP_PX, rows * (height + _TITLE_PX) + _GAP_PX)
    clouds = [dynamic(frame) for frame in frames]

    def rendered(cloud: tuple[FloatArray, ImageArray]) -> tuple[ImageArray, FloatArray]:
        moving, moving_colors = cloud
        return render(
            view,
            np.concatenate((points, moving)),
            np.concatenate((colors, moving_colors)),
            np.concatenate((size, _sizes(moving))),
            _BACKGROUND,
        )

    views = map_in_order(rendered, clouds, thread_count())
    for number, (frame, (image, depth)) in enumerate(zip(frames, views, strict=True)):
        row, column = divmod(number, columns)
        panel = collage.add_picture(image, _GAP_PX + column * (width + _GAP_PX), _TITLE_PX + row * (height + _TITLE_PX))
        _draw_trails(panel, view, depth, trails[:, max(0, frame - trail_frames) : frame + 1], trail_colors)
        _draw_cameras(panel, view, reconstruction, frame)
        panel.set_title(f"frame {frame}", loc="left", fontsize=9, color=MUTED)
    collage.save(path)


def times_of_the_subject(observed: BoolArray, count: int) -> list[int]:
    """Return up to ``count`` frames, spread over those that show at least half of the usual number of moving points.

    Args:
        observed: (K, T) whether each moving point was seen in each frame.
        count: Number of frames.
    """
    seen = observed.sum(axis=0)
    usual = np.median(seen[seen > 0]) if (seen > 0).any() else 0.0
    there = np.flatnonzero(seen >= 0.5 * usual)
    return sorted({int(there[k]) for k in spread_frames(len(there), count)})


def _thin(points: FloatArray, colors: ImageArray) -> tuple[FloatArray, ImageArray]:
    step = max(1, -(-len(points) // _MAX_STATIC_POINTS))
    return points[::step], colors[::step]


def _sizes(points: FloatArray) -> FloatArray:
    """Return the diameters (N,), meters, at which neighboring points of a cloud just touch."""
    if len(points) < 5:
        return np.full(len(points), 0.01)
    distance, _ = cKDTree(points).query(points, k=5, workers=-1)
    gap = distance[:, -1]
    result: FloatArray = 1.5 * np.minimum(gap, 3.0 * np.median(gap))
    return result


def _view(reconstruction: Reconstruction, points: FloatArray) -> View:
    """Place the virtual camera behind and above the real ones, turned to what they look at."""
    poses = reconstruction.world_T_cam
    axes = upright_axes(poses)
    forward, up = axes[1], axes[2]
    center = poses[:, :3, 3].mean(axis=0)
    seen = points if len(points) else reconstruction.dynamic_points.reshape(-1, 3)
    seen = seen[np.isfinite(seen).all(axis=1)]
    target = np.median(seen, axis=0) if len(seen) else center + 2.0 * forward
    distance = max(float(np.linalg.norm(target - center)), 1e-3)
    # Keep the gaze level with the floor: only the elevation below tilts it.
    angle = np.radians(_ELEVATION_DEG)
    gaze = target - center
    gaze = gaze - (gaze @ up) * up
    gaze = gaze / np.linalg.norm(gaze) if np.linalg.norm(gaze) > 1e-6 * distance else forward
    target = target + 0.2 * (center - target)
    eye = target - 1.9 * distance * (np.cos(angle) * gaze - np.sin(angle) * up)
    moving = reconstruction.dynamic_points.reshape(-1, 3)
    moving = moving[np.isfinite(moving).all(axis=1)]
    return _framed(look_at(eye, target, up), [seen, moving], poses[:, :3, 3])


def _framed(world_T_cam: FloatArray, clouds: list[FloatArray], cameras: FloatArray) -> View:
    """Choose the focal length and principal point that fill the panel with the clouds' bulk and the cameras."""
    height, width = _PANEL
    unit = View(world_T_cam, np.array([1.0, 1.0, 0.0, 0.0]), _PANEL)
    corners = []
    for points, outside in [*((cloud, _OUTSIDE) for cloud in clouds), (cameras, 0.0)]:
        uv, _ = unit.project(points)
        uv = uv[np.isfinite(uv).all(axis=1)]
        if len(uv):
            corners.append(np.percentile(uv, [outside, 100.0 - outside], axis=0))
    if not corners:
        return View(world_T_cam, np.array([width, width, 0.5 * width, 0.5 * height]), _PANEL)
    low = np.min([corner[0] for corner in corners], axis=0)
    high = np.max([corner[1] for corner in corners], axis=0)
    extent = np.maximum(high - low, 1e-3)
    focal = (1.0 - 2.0 * _MARGIN) * float(np.min(np.array([width, height]) / extent))
    center = 0.5 * np.array([width - 1, height - 1]) - focal * 0.5 * (low + high)
    return View(world_T_cam, np.array([focal, focal, *center]), _PANEL)


def _trails(reconstruction: Reconstruction) -> tuple[FloatArray, FloatArray]:
    """Return up to _MAX_TRAILS trajectories (M, T, 3) and their RGB (M, 3), neighbors in like colors."""
    points = reconstruction.dynamic_points
    chosen = evenly_spread(len(points), _MAX_TRAILS)
    points = points[chosen]
    if not len(points):
        return points, np.zeros((0, 3))
    known = np.asarray(np.isfinite(points).all(axis=2))
    mean = np.where(known[..., None], points, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]
    spread = mean - mean.mean(axis=0)
    main = np.linalg.svd(spread, full_matrices=False)[2][0]
    rank = np.argsort(np.argsort(spread @ main)) / max(len(points) - 1, 1)
    return points, matplotlib.colormaps["gist_rainbow"](0.9 * rank)[:, :3]


def _draw_trails(panel: Axes, view: View, depth: FloatArray, trails: FloatArray, colors: FloatArray) -> None:
    """Draw trails (M, L, 3) that end at the current frame, fading into the past; hidden parts are left out."""
    if not len(trails):
        return
    uv, z = view.project(trails)
    visible = _in_front(depth, uv, z)
    length = trails.shape[1]
    for step in range(length - 1):
        both = visible[:, step] & visible[:, step + 1]
        fade = ((step + 1) / (length - 1)) ** 1.5
        segments = np.stack((uv[both, step], uv[both, step + 1]), axis=1)
        rgba = np.concatenate((colors[both], np.full((int(both.sum()), 1), fade)), axis=1)
        panel.add_collection(LineCollection(list(segments), colors=rgba, linewidths=0.6 + fade, capstyle="round"))
    head = visible[:, -1]
    panel.scatter(uv[head, -1, 0], uv[head, -1, 1], s=5, c=colors[head], edgecolors="white", linewidths=0.35, zorder=5)


def _in_front(depth: FloatArray, uv: FloatArray, z: FloatArray) -> BoolArray:
    """Tell which projected points are inside the picture and not behind the rendered surface."""
    height, width = depth.shape
    pixel = np.rint(np.nan_to_num(uv, nan=-1.0)).clip(-1, max(height, width)).astype(np.int64)
    u, v = pixel[..., 0], pixel[..., 1]
    inside = np.isfinite(z) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    surface = depth[v.clip(0, height - 1), u.clip(0, width - 1)]
    return np.asarray(inside & (np.nan_to_num(z, nan=np.inf) <= _HIDDEN_BY * surface))


def _draw_cameras(panel: Axes, view: View, reconstruction: Reconstruction, frame: int) -> None:
    """Draw the whole camera path and the frustum of the current camera."""
    path, _ = view.project(reconstruction.world_T_cam[:, :3, 3])
    panel.plot(path[:, 0], path[:, 1], color=MUTED, linewidth=1.0, zorder=3)
    panel.plot(path[: frame + 1, 0], path[: frame + 1, 1], color=INK, linewidth=1.6, zorder=3)
    height, width = reconstruction.image_size
    fx, fy, cx, cy = reconstruction.frame_intrinsics[frame]
    target = view.world_T_cam[:3, 3]
    reach = 0.07 * float(np.linalg.norm(reconstruction.world_T_cam[frame, :3, 3] - target))
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    rays = np.stack(((corners[:, 0] - cx) / fx, (corners[:, 1] - cy) / fy, np.ones(4)), axis=1) * reach
    pose = reconstruction.world_T_cam[frame]
    world = np.concatenate((pose[None, :3, 3], rays @ pose[:3, :3].T + pose[:3, 3]))
    uv, _ = view.project(world)
    edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    lines = LineCollection([uv[list(edge)] for edge in edges], colors=INK, linewidths=1.1, zorder=4)
    lines.set_path_effects([Stroke(linewidth=2.4, foreground="white"), Normal()])
    panel.add_collection(lines)
