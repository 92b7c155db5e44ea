"""Where the virtual camera of a film is in each of its frames."""

from __future__ import annotations

from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.results.pictures.figure import upright_axes
from uni4d_fg.results.pictures.splatting import View, look_at
from uni4d_fg.slam.reconstruction import Reconstruction

_SWING_DEG, _RISE_DEG = 24.0, 9.0
_BACK = 0.35
_ELEVATION_DEG = 14.0


class FilmView(str, Enum):
    """What a film shows."""

    orbit = "orbit"
    camera = "camera"
    side_by_side = "side-by-side"


def orbit_view(result: Reconstruction, depth: float, turn: float, size: tuple[int, int]) -> View:
    """Return a view that swings around the scene: once to and fro while ``turn`` goes from 0 to 1.

    A full circle would show the back of what no camera saw.

    Args:
        result: Cameras and points.
        depth: Usual depth of the scene, meters.
        turn: Place on the path; 1 is 0 again.
        size: (height, width), px.
    """
    _, forward, up = upright_axes(result.world_T_cam)
    center = np.median(result.world_T_cam[:, :3, 3], axis=0)
    gaze = np.median(result.world_T_cam[:, :3, 2], axis=0)
    target = center + depth * gaze / max(float(np.linalg.norm(gaze)), 1e-9)
    toward = target - center
    level = toward - (toward @ up) * up
    level = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-3 * depth else forward
    angle = 2.0 * np.pi * turn
    around = Rotation.from_rotvec(np.radians(_SWING_DEG) * np.sin(angle) * up).as_matrix()
    elevation = np.radians(_ELEVATION_DEG + _RISE_DEG * np.sin(2.0 * angle))
    away = -(around @ level) * np.cos(elevation) + np.sin(elevation) * up
    eye = target + (1.0 + _BACK) * depth * away
    height, width = size
    fx, fy = np.median(result.frame_intrinsics[:, :2], axis=0) * _fitting(result, size)
    return View(look_at(eye, target, up), np.array([fx, fy, 0.5 * (width - 1), 0.5 * (height - 1)]), size)


def camera_view(result: Reconstruction, frame: int, size: tuple[int, int]) -> View:
    """Return the view of the video's own camera in one frame, without its distortion.

    Args:
        result: Cameras.
        frame: The frame.
        size: (height, width), px; what is wider or higher than the video shows more than it.
    """
    factor = _fitting(result, size)
    fx, fy, cx, cy = result.frame_intrinsics[frame]
    middle = 0.5 * (np.array(size[::-1]) - factor * np.array(result.image_size[::-1]))
    principal = factor * (np.array([cx, cy]) + 0.5) - 0.5 + middle
    return View(result.world_T_cam[frame], np.array([factor * fx, factor * fy, *principal]), size)


def film_size(result: Reconstruction, height: int, view: FilmView) -> tuple[int, int]:
    """Return (height, width) of one picture of a film, even numbers, as video formats ask for."""
    rows = max(2, height - height % 2)
    aspect = result.image_size[1] / result.image_size[0]
    if view is FilmView.orbit:
        aspect = max(aspect, 16.0 / 9.0)
    return rows, max(2, round(rows * aspect / 2.0) * 2)


def _fitting(result: Reconstruction, size: tuple[int, int]) -> float:
    """Return the factor at which the video's picture fits into a size."""
    return min(size[0] / result.image_size[0], size[1] / result.image_size[1])
