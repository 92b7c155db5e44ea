"""What pictures share: figures without global state, the frames to show, an upright world, images made smaller."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#22262b"
MUTED = "#8a9099"
GRID = "#e6e8eb"

DPI = 120
_COMPRESS_LEVEL = 3
"""Of zlib: a third of the time of the default, a twentieth more bytes."""


def new_figure(width_in: float, height_in: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """Return an empty white figure, size in inches, that draws without a display; no layout for axes placed by hand."""
    # Loading matplotlib takes a while, and who only asks for frames or axes needs none of it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


class Collage:
    """Pictures at their own pixels, with a figure drawn over them: matplotlib resamples every picture that it draws."""

    def __init__(self, width_px: int, height_px: int) -> None:
        self._paper = np.full((height_px, width_px, 3), 255, np.uint8)
        self.figure = new_figure(width_px / DPI, height_px / DPI, layout=None)
        self.figure.patch.set_alpha(0.0)

    def place(self, left: int, top: int, width: int, height: int) -> tuple[float, float, float, float]:
        """Return a place given in px from the upper left corner as matplotlib's axes want it."""
        rows, columns = self._paper.shape[:2]
        return left / columns, 1.0 - (top + height) / rows, width / columns, height / rows

    def add_picture(self, image: ImageArray, left: int, top: int) -> Axes:
        """Put an image (H, W, 3), RGB, at a pixel; return axes over it, whose units are its pixels."""
        height, width = image.shape[:2]
        self._paper[top : top + height, left : left + width] = image
        panel = self.figure.add_axes(self.place(left, top, width, height))
        panel.set_xlim(-0.5, width - 0.5)
        panel.set_ylim(height - 0.5, -0.5)
        panel.set_axis_off()
        return panel

    def pixels(self) -> ImageArray:
        """Return the picture (H, W, 3), RGB."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()  # type: ignore[no-untyped-call]
        drawn = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        touched = drawn[..., 3] > 0
        over = drawn[touched].astype(np.float32)
        share = over[:, 3:] / np.float32(255.0)
        result = self._paper.copy()
        result[touched] = np.rint(share * over[:, :3] + (1.0 - share) * result[touched])
        return result

    def save(self, path: Path) -> None:
        """Write the picture as PNG, whole or not at all.

        Raises:
            OutputError: If the file cannot be written.
        """
        level = [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESS_LEVEL]
        _, encoded = cv2.imencode(".png", cv2.cvtColor(self.pixels(), cv2.COLOR_RGB2BGR), level)
        with atomic_path(path) as temporary:
            temporary.write_bytes(encoded.tobytes())


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
