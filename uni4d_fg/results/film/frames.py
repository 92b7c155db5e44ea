"""The pictures of a film, one after another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import InputError, Uni4dFgError
from uni4d_fg.results.chunks import chunks_of
from uni4d_fg.results.film.paths import FilmView, camera_view, film_size, orbit_view
from uni4d_fg.results.fusion.dense import dense_static_cloud
from uni4d_fg.results.measures import scene_depth
from uni4d_fg.results.pictures.splatting import View, render
from uni4d_fg.results.run import Run
from uni4d_fg.results.run_clouds import moving_cloud, static_cloud

_BACKGROUND = (24, 26, 30)
_MOST_POINTS = 1_200_000
_EDGES = 0.6
_LARGER = 1.3
"""Points that only touch let through what is behind them where pixels fall between them."""
_FEWEST_SECONDS = 4.0


@dataclass
class FilmClouds:
    """The clouds that films of a run show; the static one is made once for all of them."""

    run: Run

    def __post_init__(self) -> None:
        try:
            fusion = self.run.config.fusion
        except Uni4dFgError:
            fusion = FusionConfig()
        self._fusion = fusion.model_copy(update={"dynamic_stride": 1})

    @cached_property
    def static(self) -> tuple[FloatArray, ImageArray, FloatArray]:
        """Points (N, 3), RGB (N, 3) and diameters (N,) of the static cloud, meters.

        Raises:
            InputError: If the run has no cloud and no depth to make one from.
        """
        run = self.run
        if run.sequence is not None and run.depth is not None:
            points, colors = dense_static_cloud(
                run.sequence, run.depth, run.confidence, run.reconstruction, self._fusion, _MOST_POINTS
            )
        else:
            cloud, _ = static_cloud(run, self._fusion)
            if cloud is None:
                raise InputError(
                    f"{run.folder.root}: has no clouds, and no depth or images to make them from; "
                    "runs of `stream` have none"
                )
            thin = cloud.thinned(_MOST_POINTS)
            points, colors = thin.points.astype(np.float64), thin.colors
        return points, colors, _sizes(points)

    def at(self, frame: int) -> tuple[FloatArray, ImageArray, FloatArray]:
        """Return the same for everything in one frame."""
        points, colors, sizes = self.static
        moving = moving_cloud(self.run, frame, self._fusion)
        if moving is None or not len(moving.points):
            return points, colors, sizes
        here = moving.points.astype(np.float64)
        return (
            np.concatenate((points, here)),
            np.concatenate((colors, moving.colors)),
            np.concatenate((sizes, _sizes(here))),
        )


@dataclass
class Film:
    """Draws a run from one kind of place at any frame.

    Raises:
        InputError: If the video is shown as well and is not at hand.
    """

    clouds: FilmClouds
    view: FilmView
    height: int

    def __post_init__(self) -> None:
        self.run = self.clouds.run
        if self.view is FilmView.side_by_side and self.run.sequence is None:
            self.run.need_sequence()
        self._depth = scene_depth(self.run.reconstruction)
        self.size = film_size(self.run.reconstruction, self.height, self.view)

    def picture(self, frame: int, turn: float) -> ImageArray:
        """Return the picture (H, W, 3), RGB.

        Args:
            frame: Frame of the video.
            turn: Place on the orbit, 0 to 1.
        """
        result = self.run.reconstruction
        if self.view is FilmView.orbit:
            return self._seen(frame, orbit_view(result, self._depth, turn, self.size))
        if self.view is FilmView.camera:
            return self._seen(frame, camera_view(result, frame, self.size))
        height, width = self.size
        sequence = self.run.sequence or self.run.need_sequence()
        image = sequence.images[frame]
        video = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        return np.concatenate((video, self._seen(frame, orbit_view(result, self._depth, turn, self.size))), axis=1)

    def _seen(self, frame: int, view: View) -> ImageArray:
        image, _ = render(view, *self.clouds.at(frame), _BACKGROUND, smallest_px=0.0, edge_strength=_EDGES)
        return image


def schedule(num_frames: int, frames_per_second: float) -> Iterator[tuple[int, float]]:
    """Yield the frame of the video and the place on the orbit of every picture of a film.

    A short video is played several times, so that the orbit is not a rush; the last picture leads to the first.
    """
    times = max(1, int(np.ceil(_FEWEST_SECONDS * frames_per_second / num_frames)))
    for number in range(times * num_frames):
        yield number % num_frames, number / (times * num_frames)


def _sizes(points: FloatArray) -> FloatArray:
    """Return the diameter of every point (N,) at which neighbors touch, meters: one per chunk."""
    sizes = np.zeros(len(points))
    for chunk in chunks_of(points, 4096):
        sizes[chunk.rows] = _LARGER * chunk.diameter
    return sizes
