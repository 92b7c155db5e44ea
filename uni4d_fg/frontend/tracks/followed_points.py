"""The points that a tracker follows at present, with what it knows of each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.tracks.first_views import FirstViews, refines
from uni4d_fg.frontend.tracks.guided_search import move_points


@dataclass
class FollowedPoints:
    """N points of one image, which move to the next."""

    config: TrackingConfig
    track: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) which track each belongs to."""
    points: Float32Array = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    """(N, 2) px."""
    velocity: Float32Array = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    """(N, 2) px, the last step of each point; NaN before its first one."""
    views: FirstViews | None = field(init=False)
    """Of the points, if they are refined; else they move by steps alone."""

    def __post_init__(self) -> None:
        self.views = FirstViews(self.config) if refines(self.config) else None

    @property
    def blur_px(self) -> float:
        """Length of the camera's motion blur in the image that the points are in; 0 if it is not looked at."""
        return 0.0 if self.views is None else float(np.linalg.norm(self.views.blur))

    def add(self, image: ImageArray, track: IntArray, points: Float32Array) -> None:
        """Append points (M, 2) px of tracks (M,) that are first seen, or seen again, in an image (H, W) uint8."""
        self.track = np.concatenate((self.track, track))
        self.points = np.concatenate((self.points, points))
        self.velocity = np.concatenate((self.velocity, np.full_like(points, np.nan)))
        if self.views is not None:
            self.views.add(image, points)

    def move(self, source: ImageArray, target: ImageArray) -> None:
        """Follow all points from one gray image (H, W) uint8 to the next, and forget those that are lost."""
        if self.views is None:
            kept, moved = move_points(source, target, self.points, self.velocity, self.config)
        else:
            kept, moved = self.views.follow(source, target, self.points, self.velocity)
        self.track, self.points, self.velocity = self.track[kept], moved, moved - self.points[kept]

    def select(self, keep: BoolArray) -> None:
        """Forget all points but those of a mask (N,)."""
        self.track, self.points, self.velocity = self.track[keep], self.points[keep], self.velocity[keep]
        if self.views is not None:
            self.views.select(keep)
