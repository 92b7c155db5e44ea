"""Lucas-Kanade tracking of a stream: one image at a time, a bounded number of points.

Points start on the grid of the batch tracker (:mod:`uni4d_fg.frontend.tracks.lucas_kanade`) every ``query_interval``
frames, but only where no live point is near: a camera at rest would otherwise collect grids without end. They are
followed by their first views where those of the batch are. Lost points are not looked for again. There is no backward
sweep, because earlier images are gone.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import Float32Array, ImageArray, IntArray, evenly_spread
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.tracks.first_views import FirstViews, follow_points, refines
from uni4d_fg.frontend.tracks.lucas_kanade import query_grid
from uni4d_fg.slam.incremental.model import FrameTracks


@dataclass
class OnlineTracker:
    """Follows points from image to image."""

    config: TrackingConfig
    max_tracks: int
    previous: ImageArray | None = None
    """(H, W) the last image, gray."""
    track: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    points: Float32Array = field(default_factory=lambda: np.zeros((0, 2), dtype=np.float32))
    velocity: Float32Array = field(default_factory=lambda: np.zeros((0, 2), dtype=np.float32))
    """(N, 2) px, the last step of each point; NaN before its first one."""
    views: FirstViews | None = field(init=False)
    """Of the points, if they are refined."""
    next_track: int = 0
    since_query: int = 0

    def __post_init__(self) -> None:
        self.views = FirstViews(self.config) if refines(self.config) else None

    def advance(self, image: ImageArray) -> FrameTracks:
        """Follow the points to the next image (H, W, 3) or (H, W) uint8 and start new ones where there are none."""
        gray: ImageArray = np.ascontiguousarray(
            image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), dtype=np.uint8
        )
        if self.previous is not None:
            kept, moved = follow_points(self.views, self.previous, gray, self.points, self.velocity, self.config)
            self.track, self.points, self.velocity = self.track[kept], moved, moved - self.points[kept]
        if self.previous is None or self.since_query >= self.config.query_interval:
            self._start(gray)
            self.since_query = 0
        self.since_query += 1
        self.previous = gray
        return FrameTracks(self.track.copy(), self.points.astype(np.float64))

    def _start(self, image: ImageArray) -> None:
        image_size = (image.shape[0], image.shape[1])
        grid = query_grid(image_size, self.config)
        if len(self.points):
            spacing = 0.5 * max(image_size[1] / self.config.grid_columns, image_size[0] / self.config.grid_rows)
            distance, _ = cKDTree(self.points).query(grid)
            grid = grid[distance > spacing]
        room = max(self.max_tracks - len(self.points), 0)
        if len(grid) > room:
            grid = grid[evenly_spread(len(grid), room)]
        self.track = np.concatenate([self.track, self.next_track + np.arange(len(grid), dtype=np.int64)])
        self.points = np.concatenate([self.points, grid])
        self.velocity = np.concatenate([self.velocity, np.full_like(grid, np.nan)])
        self.next_track += len(grid)
        if self.views is not None:
            self.views.add(image, grid)
