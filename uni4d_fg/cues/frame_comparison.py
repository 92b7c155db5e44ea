"""Frames compared with others around them, each as a static scene would look there; a window of frames is held."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
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
from uni4d_fg.optim.threads import OrderedMap, made_ahead, thread_count, workers_in_order
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.scene import Cameras

PreparedT = TypeVar("PreparedT")
ResultT = TypeVar("ResultT")

_FRAMES_PER_THREAD = 1
"""So many frames are compared while as many that follow them are prepared."""


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
    """Compares every frame with others before and after it. Those who inherit say what they look for.

    Args:
        given: The video.
        config: Sigmas and sizes.
        baselines: So many frames before and after.
    """

    def __init__(self, given: ComparedVideo, config: MotionMaskConfig, baselines: Sequence[int]) -> None:
        self.given, self.config, self.baselines = given, config, baselines
        image_size = given.video.image_size
        self.size = shrunk_size(image_size, working_scale(image_size, config.working_size_px))
        self.scale = np.array([self.size[1] / image_size[1], self.size[0] / image_size[0]])
        self.pixels = PixelGrid.of(replace(given.camera, intrinsics=given.cameras.intrinsics), self.size, image_size)
        self.grid = QuadraticGrid.of(self.size, self.scale, image_size)
        self.frames: dict[int, PreparedT] = {}
        """Those that are held."""

    @abstractmethod
    def prepared(self, frame: int) -> PreparedT:
        """Prepare a frame, on any thread. It is held for as long as others are compared with it."""

    @abstractmethod
    def evidence(self, frame: int) -> Evidence:
        """Return the evidence that pixels of a frame move, at working size; on any thread, while it is held."""

    def others(self, frame: int) -> list[list[int]]:
        """Return the frames that a frame is compared with, those of each baseline together; none where a video ends."""
        count = self.given.video.num_frames
        return [[f for f in (frame - step, frame + step) if 0 <= f < count] for step in self.baselines]

    def of_frames(self, made: Callable[[int], ResultT], stop: Callable[[], bool]) -> Iterator[ResultT]:
        """Yield what is made of each frame, in order, on all threads; frames and those they ask for are held then.

        Raises:
            Cancelled: If ``stop`` turned true.
        """
        threads = thread_count()
        with workers_in_order(threads) as mapped:
            for frames in made_ahead(self._held(_FRAMES_PER_THREAD * threads, mapped, stop), threads, ahead=1):
                yield from mapped(made, frames)

    def _held(self, together: int, mapped: OrderedMap, stop: Callable[[], bool]) -> Generator[list[int], None, None]:
        """Yield frames that follow each other when all that they need is held, as it is for those yielded before."""
        count, reach = self.given.video.num_frames, max(self.baselines)
        for start in range(0, count, together):
            if stop():
                raise Cancelled("stopped while comparing frames for the motion masks")
            frames = list(range(start, min(start + together, count)))
            needed = set(frames).union(*(sides for frame in frames for sides in self.others(frame)))
            missing = sorted(needed - self.frames.keys())
            self.frames.update(zip(missing, mapped(self.prepared, missing), strict=True))
            for old in [frame for frame in self.frames if frame < start - together - reach]:
                del self.frames[old]
            yield frames

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
