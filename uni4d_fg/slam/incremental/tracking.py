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

from uni4d_fg.arrays import ImageArray, evenly_spread
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.tracks.followed_points import FollowedPoints
from uni4d_fg.frontend.tracks.lucas_kanade import query_grid
from uni4d_fg.slam.incremental.model import FrameTracks


@dataclass
class OnlineTracker:
    """Follows points from image to image."""

    config: TrackingConfig
    max_tracks: int
    previous: ImageArray | None = None
    """(H, W) the last image, gray."""
    followed: FollowedPoints = field(init=False)
    next_track: int = 0
    since_query: int = 0

    def __post_init__(self) -> None:
        self.followed = FollowedPoints(self.config)

    def advance(self, image: ImageArray) -> FrameTracks:
        """Follow the points to the next image (H, W, 3) or (H, W) uint8 and start new ones where there are none."""
        gray: ImageArray = np.ascontiguousarray(
            image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), dtype=np.uint8
        )
        if self.previous is not None:
            self.followed.move(self.previous, gray)
        if self.previous is None or self.since_query >= self.config.query_interval:
            self._start(gray)
            self.since_query = 0
        self.since_query += 1
        self.previous = gray
        return FrameTracks(self.followed.track.copy(), self.followed.points.astype(np.float64))

    def _start(self, image: ImageArray) -> None:
        image_size = (image.shape[0], image.shape[1])
        grid = query_grid(image_size, self.config)
        live = self.followed.points
        if len(live):
            spacing = 0.5 * max(image_size[1] / self.config.grid_columns, image_size[0] / self.config.grid_rows)
            distance, _ = cKDTree(live).query(grid)
            grid = grid[distance > spacing]
        room = max(self.max_tracks - len(live), 0)
        if len(grid) > room:
            grid = grid[evenly_spread(len(grid), room)]
        self.followed.add(image, self.next_track + np.arange(len(grid), dtype=np.int64), grid)
        self.next_track += len(grid)
