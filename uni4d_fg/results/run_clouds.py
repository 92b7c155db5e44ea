"""The dense clouds of a run, for everyone who shows or hands them on: those it wrote, else made from its depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.geometry.nearest_points import NearestPoints
from uni4d_fg.results.clouds import read_ply
from uni4d_fg.results.fusion import clouds
from uni4d_fg.results.run import Run
from uni4d_fg.slam.reconstruction import Reconstruction


class ColoredPoints(NamedTuple):
    """A cloud whose points know their instance."""

    points: Float32Array
    """(N, 3) world positions, meters."""
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


def static_cloud(
    run: Run, fusion: FusionConfig, max_frames: int = 0, limit: int | None = None
) -> tuple[ColoredPoints | None, str]:
    """Return the cloud of what does not move, if the run has one, and where it is from: 'files', 'depth' or 'none'.

    Args:
        run: The run.
        fusion: Strides, voxel size and edges of a cloud that is made from depth.
        max_frames: Frames that such a cloud takes at most; as ``fusion`` says for 0.
        limit: Most points that are read of a file; all if None.

    Raises:
        InputError: If a file cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    path = run.folder.static_cloud
    if path.is_file():
        points, colors = read_ply(path, limit)
        return ColoredPoints.of(points, colors, np.zeros(len(points), np.int32)), "files"
    sequence, depth, result = run.sequence, run.depth, run.reconstruction
    if sequence is None or depth is None:
        return None, "none"
    if max_frames:
        stride = max(fusion.static_frame_stride, -(-run.num_frames // max_frames))
        fusion = fusion.model_copy(update={"static_frame_stride": stride})
    masks = sequence.masks if sequence.masks is not None else _NoMasks(run.num_frames, sequence.image_size)
    cloud = clouds.static_cloud(
        sequence.images, depth, masks, result.frame_intrinsics, result.world_T_cam, fusion,
        confidence=run.confidence, lens=result.lens,
    )  # fmt: skip
    return ColoredPoints.of(*cloud, np.zeros(len(cloud.points), np.int32)), "depth"


def moving_cloud(run: Run, frame: int, fusion: FusionConfig) -> ColoredPoints | None:
    """Return the cloud of what moves in one frame, if the run has one.

    Made from depth where it can be, because masks then say which instance a point is of; the points of a file are of
    the instance of the nearest trajectory.

    Raises:
        InputError: If a file cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    sequence, depth, result = run.sequence, run.depth, run.reconstruction
    if sequence is not None and depth is not None:
        if sequence.masks is None:
            return None
        mask, here = sequence.masks[frame], depth[frame]
        keep = (mask > 0) & ~clouds.depth_edges(here, fusion.edge_relative_gradient)
        camera = result.frame_intrinsics[frame], result.world_T_cam[frame], fusion.dynamic_stride, result.lens
        points, colors = clouds.lift(sequence.images[frame], here, keep, *camera)
        instance = clouds.lift(np.asarray(mask), here, keep, *camera).colors.astype(np.int32)
        return ColoredPoints.of(points, colors, instance)
    path = run.folder.dynamic_cloud(frame)
    if not path.is_file():
        return None
    points, colors = read_ply(path)
    return ColoredPoints.of(points, colors, _nearest_instance(result, points, frame))


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
    if not known.any():
        return np.ones(len(points), np.int32)
    _, nearest = NearestPoints(here[known]).find(points, 1)
    instance: Int32Array = reconstruction.dynamic_instance[known][nearest[:, 0]]
    return instance
