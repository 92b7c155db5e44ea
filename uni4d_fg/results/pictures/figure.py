"""What pictures share: figures without global state, the frames to show, an upright world, images made smaller."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK = "#22262b"
MUTED = "#8a9099"
GRID = "#e6e8eb"

_COMPRESS_LEVEL = 3
"""Of zlib: a third of the time of the default, a twentieth more bytes."""


def new_figure(width_in: float, height_in: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """Return an empty white figure, size in inches, that draws without a display; no layout for axes placed by hand."""
    # Loading matplotlib takes a while, and who only asks for frames or axes needs none of it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=120, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG, whole or not at all.

    Raises:
        OutputError: If the file cannot be written.
    """
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", pil_kwargs={"compress_level": _COMPRESS_LEVEL})


def spread_frames(num_frames: int, count: int) -> list[int]:
    """Return up to ``count`` different frames from the first to the last, evenly spread."""
    return sorted({int(t) for t in np.rint(np.linspace(0, num_frames - 1, min(count, num_frames)))})


def upright_axes(world_T_cam: FloatArray) -> FloatArray:
    """Return (3, 3) with rows right, forward and up: the cameras' mean orientation, forward first.

    Args:
        world_T_cam: (T, 4, 4) camera to world, OpenCV axes.
    """
    up = -world_T_cam[:, :3, 1].mean(axis=0)
    if np.linalg.norm(up) < 1e-6:
        up = -world_T_cam[0, :3, 1]
    up = up / np.linalg.norm(up)
    forward = world_T_cam[:, :3, 2].mean(axis=0)
    forward = forward - (forward @ up) * up
    if np.linalg.norm(forward) < 1e-6:
        forward = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    forward = forward / np.linalg.norm(forward)
    return np.stack((np.cross(forward, up), forward, up))


def thumbnail(image: ImageArray, width: int) -> ImageArray:
    """Return an image (H, W, 3) no wider than ``width`` px."""
    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
