"""The built-in tracker: grids of points followed by pyramidal Lucas-Kanade, forwards and backwards in time.

A grid of query points is started in frames 0, ``query_interval``, 2 ``query_interval``, ... Two sweeps over
the video follow them: one forwards, in which every grid joins as the sweep passes its frame, and one
backwards. A step moves all live points of all grids at once, so that a sweep costs two optical-flow calls
per pair of frames, however many grids there are, plus a short one per live grid for the drift check. Only
the two images of the step and the grey query images of live grids are held.

A point that fails a check of :mod:`uni4d_fg.tracks.optical_flow` is lost, and not looked for again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray, Int32Array, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.sequence.model import FrameSource
from uni4d_fg.tracks.model import Tracks
from uni4d_fg.tracks.optical_flow import has_not_drifted, move_points

Progress = Callable[[int, int], None]
"""Called with the number of steps done and the number of steps in all."""
ShouldStop = Callable[[], bool]
"""Asked between steps; True ends the work with :class:`~uni4d_fg.errors.Cancelled`."""

_Observations = list[tuple[int, IntArray, Float32Array]]  # frame, track indices (n,), pixels (n, 2)


def query_grid(image_size: tuple[int, int], config: TrackingConfig) -> Float32Array:
    """Return the query points (rows * columns, 2) in px, row by row, of an image of (height, width)."""
    height, width = image_size
    # On a tiny image the margin must not push the two sides past each other.
    margin_x = min(config.margin_px, (width - 1) / 2)
    margin_y = min(config.margin_px, (height - 1) / 2)
    columns = np.linspace(margin_x, width - 1 - margin_x, config.grid_columns)
    rows = np.linspace(margin_y, height - 1 - margin_y, config.grid_rows)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return grid.astype(np.float32)


def track_grid(
    images: FrameSource[ImageArray],
    config: TrackingConfig,
    progress: Progress | None = None,
    should_stop: ShouldStop | None = None,
) -> Tracks:
    """Track grids of points through a video.

    Args:
        images: T images (H, W, 3) uint8 RGB, or (H, W) uint8 grey; each is read twice, in order.
        config: Grid, window and checks.
        progress: Told the steps done and to do after every step.
        should_stop: Asked before every step.

    Returns:
        The tracks seen in at least ``min_observations`` frames (or in all, if the video is shorter).

    Raises:
        InputError: If the images differ in size or are not uint8.
        Cancelled: If ``should_stop`` said so.
    """
    num_frames = len(images)
    if num_frames == 0:
        raise InputError("tracking: the sequence has no images")
    image_size = _grey(images[0], None, 0).shape
    grid = query_grid((image_size[0], image_size[1]), config)
    query_frames = list(range(0, num_frames, config.query_interval))
    observations: _Observations = [(frame, _track_indices(i, grid), grid) for i, frame in enumerate(query_frames)]
    steps_done, steps = 0, 2 * (num_frames - 1)
    for order in (range(num_frames), range(num_frames - 1, -1, -1)):
        live = _LivePoints(grid)
        previous: ImageArray | None = None
        for frame in order:
            if should_stop is not None and should_stop():
                raise Cancelled(f"tracking stopped at step {steps_done} of {steps}")
            image = _grey(images[frame], image_size, frame)
            if previous is not None:
                live.move(previous, image, config)
                observations.append((frame, live.track, live.points))
                steps_done += 1
                if progress is not None:
                    progress(steps_done, steps)
            if frame % config.query_interval == 0:
                live.start(frame // config.query_interval, image)
            previous = image
    query_frame = np.repeat(np.asarray(query_frames, np.int32), len(grid))
    return _assemble(observations, query_frame, num_frames, config.min_observations)


@dataclass
class _LivePoints:
    """The points that one sweep follows at present.

    Track ``i`` belongs to grid ``i // len(grid)`` and started at query point ``i % len(grid)`` of it.
    """

    grid: Float32Array
    track: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    points: Float32Array = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    query_images: dict[int, ImageArray] = field(default_factory=dict)

    def start(self, grid_index: int, image: ImageArray) -> None:
        """Add the points of a grid in the frame where they start."""
        self.track = np.concatenate((self.track, _track_indices(grid_index, self.grid)))
        self.points = np.concatenate((self.points, self.grid))
        self.query_images[grid_index] = image

    def move(self, source: ImageArray, target: ImageArray, config: TrackingConfig) -> None:
        """Follow all points to the next image and forget those that are lost."""
        kept, self.points = move_points(source, target, self.points, config)
        self.track = self.track[kept]
        grid_of_track, query_point = np.divmod(self.track, len(self.grid))
        keep = np.ones(len(self.track), np.bool_)
        for grid_index, query_image in list(self.query_images.items()):
            members = np.flatnonzero(grid_of_track == grid_index)
            keep[members] = has_not_drifted(
                query_image, target, self.grid[query_point[members]], self.points[members], config
            )
            if not keep[members].any():
                del self.query_images[grid_index]
        self.track, self.points = self.track[keep], self.points[keep]


def _track_indices(grid_index: int, grid: Float32Array) -> IntArray:
    return np.arange(grid_index * len(grid), (grid_index + 1) * len(grid), dtype=np.int64)


def _grey(image: ImageArray, expected: tuple[int, ...] | None, frame: int) -> ImageArray:
    """Return the image as (H, W) uint8; ``expected`` is the size of the first frame."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise InputError(
            f"tracking: image {frame} has dtype {image.dtype} and shape {image.shape}; "
            "expected uint8 (H, W, 3) or (H, W)"
        )
    grey = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    if expected is not None and grey.shape != expected:
        raise InputError(f"tracking: image {frame} is {grey.shape}, the first one is {expected}")
    return np.ascontiguousarray(grey)


def _assemble(
    observations: _Observations,
    query_frame: Int32Array,
    num_frames: int,
    min_observations: int,
) -> Tracks:
    """Scatter per-frame observations into arrays, leaving out tracks seen too rarely."""
    seen = np.zeros(len(query_frame), np.int64)
    for _, tracks, _ in observations:
        seen[tracks] += 1
    keep = seen >= min(min_observations, num_frames)
    row = np.cumsum(keep) - 1
    uv = np.full((int(keep.sum()), num_frames, 2), np.nan, np.float32)
    visible = np.zeros(uv.shape[:2], np.bool_)
    for frame, tracks, points in observations:
        kept = keep[tracks]
        rows = row[tracks[kept]]
        uv[rows, frame] = points[kept]
        visible[rows, frame] = True
    return Tracks(uv, visible, query_frame[keep])
