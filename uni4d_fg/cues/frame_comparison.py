"""Frames compared with others around them, each as a static scene would look there; a window of frames is held."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, TypeVar

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.dense_flow import shrink, shrunk_size, working_scale
from uni4d_fg.cues.moving_regions import track_evidence
from uni4d_fg.cues.pixel_grid import PixelGrid
from uni4d_fg.cues.static_scene import StaticPrediction, relative_pose
from uni4d_fg.cues.track_motion import QuadraticGrid, TrackMotion
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import FrameSource, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.optim.threads import OrderedMap, thread_count, workers_in_order
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.scene import Cameras

PreparedT = TypeVar("PreparedT")


class Evidence(NamedTuple):
    """What is said of the pixels (h, w) of a frame."""

    log_odds: Float32Array
    """That they move."""
    weight: Float32Array
    """How much of it was seen, 0 to 1: less is assumed."""


@dataclass(frozen=True)
class ComparedVideo:
    """A video, and what its frames are compared by."""

    video: Video
    depths: FrameSource[Float32Array]
    """T maps (H, W), NaN where missing."""
    tracks: Tracks
    motion: TrackMotion
    """Which of them move."""
    cameras: Cameras
    camera: CameraModel
    is_interpolated: bool
    """Depth is that of points of the static scene, and knows nothing of what moves."""

    def threshold(self, config: MotionMaskConfig) -> float:
        """Return the log odds above which a pixel moves."""
        return config.interpolated_threshold if self.is_interpolated else config.threshold


class FrameComparison(ABC, Generic[PreparedT]):
    """Compares every frame with some others. Those who inherit say with which, and what they look for."""

    def __init__(self, given: ComparedVideo, config: MotionMaskConfig) -> None:
        self.given, self.config = given, config
        image_size = given.video.image_size
        self.size = shrunk_size(image_size, working_scale(image_size, config.working_size_px))
        self.scale = np.array([self.size[1] / image_size[1], self.size[0] / image_size[0]])
        self.pixels = PixelGrid.of(replace(given.camera, intrinsics=given.cameras.intrinsics), self.size, image_size)
        self.grid = QuadraticGrid.of(self.size, self.scale, image_size)
        self.frames: dict[int, PreparedT] = {}

    @abstractmethod
    def prepared(self, frame: int) -> PreparedT:
        """Prepare a frame. It is held for as long as others are compared with it."""

    def begin(self, frame: int) -> None:
        """Prepare what only the comparisons of this frame need."""

    @abstractmethod
    def pairs(self, frame: int) -> list[tuple[int, int]]:
        """Return the pairs of frames that tell what moves in a frame, which is the first of each."""

    @abstractmethod
    def pair(self, pair: tuple[int, int]) -> Float32Array:
        """Return what the second frame of a pair says of the pixels (h, w) of the first; on any thread."""

    @abstractmethod
    def combined(self, frame: int, said: Iterator[Float32Array]) -> Evidence:
        """Return the evidence of a frame from what its pairs say, in their order."""

    def evidence(self, stop: Callable[[], bool]) -> Generator[Evidence, None, None]:
        """Yield the evidence that pixels of a frame move, at working size, frame by frame.

        Raises:
            Cancelled: If ``stop`` turned true.
        """
        count = self.given.video.num_frames
        with workers_in_order(thread_count()) as mapped:
            said = self._compared(0, mapped)
            for frame in range(count):
                if stop():
                    raise Cancelled("stopped while comparing frames for the motion masks")
                found = self.combined(frame, said)
                if frame + 1 < count:  # on the threads, while the caller finds regions
                    said = self._compared(frame + 1, mapped)
                yield found

    def _compared(self, frame: int, mapped: OrderedMap) -> Iterator[Float32Array]:
        """Begin to compare a frame with others; return what :meth:`pair` says of each."""
        pairs = self.pairs(frame)
        needed = {frame, *(f for pair in pairs for f in pair)}
        for other in sorted(needed - self.frames.keys()):
            self.frames[other] = self.prepared(other)
        for old in [f for f in self.frames if f < min(needed) - 1]:  # the one before is still looked at
            del self.frames[old]
        self.begin(frame)
        return mapped(self.pair, pairs)

    def predicted(self, z: Float32Array, pair: tuple[int, int]) -> StaticPrediction:
        """Return where a static scene has pixels of depth z (h, w), with what errors of the cameras add to that."""
        source, target = pair
        pose = relative_pose(self.given.cameras.world_T_cam, source, target)
        static = self.pixels.predict(z, pose, source, target)
        error = self.given.motion.shared.get(pair)
        if error is None:
            return static
        plain = self.pixels.camera.is_plain
        x, y = self.grid.displacement(error) if plain else self.pixels.displacement(error, source, target)
        return replace(static, u=np.asarray(static.u, np.float32) + x, v=np.asarray(static.v, np.float32) + y)

    def image(self, frame: int) -> ImageArray:
        """Return a frame (h, w, 3) at working size."""
        return shrink(self.given.video.images[frame], self.size)

    def depth(self, frame: int) -> Float32Array:
        """Return the depth (h, w) of a frame at working size."""
        height, width = self.size
        depth = cv2.resize(self.given.depths[frame], (width, height), interpolation=cv2.INTER_NEAREST)
        return np.asarray(depth, np.float32)

    def appearance_settings(self, frame: int) -> tuple[float, int, MotionMaskConfig]:
        """Return what an appearance is prepared with besides image and depth."""
        edge = max(1, round(self.config.depth_edge_px * float(self.scale.mean())))
        return float(self.given.cameras.log_scale[frame]), edge, self.config

    def track_evidence(self, frame: int) -> Float32Array:
        """Return what the tracks say of the pixels (h, w) of a frame, from -1 (static) to 1 (moving)."""
        return track_evidence(self.given.tracks, self.given.motion, frame, self.size, self.scale, self.config)
