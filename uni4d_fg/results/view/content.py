"""What the viewer shows of a run, thinned so that a browser can draw it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import Uni4dFgError
from uni4d_fg.results.clouds import read_ply
from uni4d_fg.results.fusion.clouds import depth_edges, lift, static_cloud
from uni4d_fg.results.run import Run
from uni4d_fg.slam.reconstruction import Reconstruction

_CACHED_FRAMES = 64
_MAX_LIFTED_FRAMES = 60


class ColoredPoints(NamedTuple):
    """A cloud whose points know their instance."""

    points: Float32Array
    """(N, 3) world positions, metres."""
    colors: ImageArray
    """(N, 3) RGB."""
    instance: Int32Array
    """(N,) mask id; 0 is static."""

    @classmethod
    def of(cls, points: FloatArray, colors: ImageArray, instance: Int32Array) -> ColoredPoints:
        """Take over positions in single precision, which is what is drawn."""
        return cls(points.astype(np.float32), colors, instance)

    def thinned(self, limit: int) -> ColoredPoints:
        """Return at most ``limit`` points, chosen at random but the same every time."""
        if len(self.points) <= limit:
            return self
        keep = np.sort(np.random.default_rng(0).choice(len(self.points), limit, replace=False))
        return ColoredPoints(self.points[keep], self.colors[keep], self.instance[keep])


NOTHING = ColoredPoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.int32))


@dataclass(frozen=True)
class Limits:
    """How much is sent to the browser."""

    static_points: int = 400_000
    dynamic_points: int = 40_000
    """Per frame."""
    landmarks: int = 60_000
    trajectories: int = 1_500
    cameras: int = 120
    """Frusta; of a longer video every n-th is drawn."""
    camera_images: int = 40
    image_width: int = 160


@dataclass
class RunClouds:
    """The dense clouds of a run: those it wrote, else made from its depth, else none.

    ``source`` says which: 'files', 'depth' or 'none'.
    """

    run: Run
    limits: Limits
    fusion: FusionConfig = field(init=False)
    _cache: OrderedDict[int, ColoredPoints] = field(default_factory=OrderedDict)

    def __post_init__(self) -> None:
        try:
            self.fusion = self.run.config.fusion
        except Uni4dFgError:
            # A run of another version may hold fields that this one does not know; the clouds can do without.
            self.fusion = FusionConfig()

    def static(self) -> tuple[ColoredPoints, str]:
        """Return the static cloud and where it comes from."""
        path = self.run.folder.static_cloud
        if path.is_file():
            points, colors = read_ply(path)
            return ColoredPoints.of(points, colors, np.zeros(len(points), np.int32)).thinned(
                self.limits.static_points
            ), "files"
        sequence, depth = self.run.sequence, self.run.depth
        if sequence is None or depth is None:
            return NOTHING, "none"
        stride = max(self.fusion.static_frame_stride, -(-self.run.num_frames // _MAX_LIFTED_FRAMES))
        cloud = static_cloud(
            sequence.images,
            depth,
            sequence.masks if sequence.masks is not None else _NoMasks(self.run.num_frames, sequence.image_size),
            self.run.reconstruction.intrinsics,
            self.run.reconstruction.world_T_cam,
            self.fusion.model_copy(update={"static_frame_stride": stride}),
            lens=self.run.reconstruction.lens,
        )
        return ColoredPoints.of(*cloud, np.zeros(len(cloud.points), np.int32)).thinned(
            self.limits.static_points
        ), "depth"

    def dynamic(self, frame: int) -> ColoredPoints:
        """Return the cloud of what moves in one frame."""
        if frame in self._cache:
            self._cache.move_to_end(frame)
            return self._cache[frame]
        cloud = self._dynamic(frame).thinned(self.limits.dynamic_points)
        self._cache[frame] = cloud
        if len(self._cache) > _CACHED_FRAMES:
            self._cache.popitem(last=False)
        return cloud

    def _dynamic(self, frame: int) -> ColoredPoints:
        sequence, depth = self.run.sequence, self.run.depth
        reconstruction = self.run.reconstruction
        if sequence is not None and depth is not None:
            if sequence.masks is None:
                return NOTHING
            mask, here = sequence.masks[frame], depth[frame]
            keep = (mask > 0) & ~depth_edges(here, self.fusion.edge_relative_gradient)
            camera = (
                reconstruction.intrinsics,
                reconstruction.world_T_cam[frame],
                self.fusion.dynamic_stride,
                reconstruction.lens,
            )
            points, colors = lift(sequence.images[frame], here, keep, *camera)
            instance = lift(np.asarray(mask), here, keep, *camera).colors.astype(np.int32)
            return ColoredPoints.of(points, colors, instance)
        path = self.run.folder.dynamic_cloud(frame)
        if not path.is_file():
            return NOTHING
        points, colors = read_ply(path)
        return ColoredPoints.of(points, colors, _nearest_instance(reconstruction, points, frame))


@dataclass(frozen=True)
class _NoMasks:
    """The masks of a video in which nothing moves."""

    num_frames: int
    image_size: tuple[int, int]

    def __len__(self) -> int:
        return self.num_frames

    def __getitem__(self, frame: int) -> Int32Array:
        return np.zeros(self.image_size, np.int32)

    def __iter__(self) -> Iterator[Int32Array]:
        return (self[frame] for frame in range(self.num_frames))


def _nearest_instance(reconstruction: Reconstruction, points: FloatArray, frame: int) -> Int32Array:
    """Return the instance of the nearest trajectory for each point (N, 3); 1 where there is none."""
    here = reconstruction.dynamic_points[:, frame]
    known = np.isfinite(here).all(axis=1)
    if not known.any() or not len(points):
        return np.ones(len(points), np.int32)
    _, nearest = cKDTree(here[known]).query(points)
    instance: Int32Array = reconstruction.dynamic_instance[known][nearest]
    return instance
