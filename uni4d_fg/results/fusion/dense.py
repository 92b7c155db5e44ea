"""The static cloud at the images' resolution: a point per footprint of a pixel, of the frame that saw it nearest."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.results.fusion.clouds import Cloud, depth_edges, dilate, least_confidence, lift
from uni4d_fg.slam.reconstruction import Reconstruction

_BAND_PX = 5
_POINTS_BETWEEN_MERGES = 3_000_000
_COARSER = 1.25
_USUAL_DEPTH_PERCENTILE = 40.0


class _Seen(NamedTuple):
    """Points, and the depth at which each was seen."""

    points: Float32Array
    colors: ImageArray
    depth: Float32Array

    def and_of(self, other: _Seen) -> _Seen:
        return _Seen(
            np.concatenate((self.points, other.points)),
            np.concatenate((self.colors, other.colors)),
            np.concatenate((self.depth, other.depth)),
        )

    def nearest_per_voxel(self, voxel: float) -> _Seen:
        """Keep the point that was seen from nearest in every cube of side ``voxel``."""
        if not len(self.points):
            return self
        cell = np.floor(self.points.astype(np.float64) / voxel).astype(np.int64) & 0x1FFFFF
        key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
        order = np.argsort(self.depth, kind="stable")
        _, first = np.unique(key[order], return_index=True)
        keep = order[first]
        return _Seen(self.points[keep], self.colors[keep], self.depth[keep])


def dense_static_cloud(
    sequence: Sequence | Video,
    depths: FrameSource[Float32Array],
    confidence: FrameSource[Float32Array] | None,
    result: Reconstruction,
    fusion: FusionConfig,
    max_points: int,
    *,
    max_frames: int = 60,
    should_stop: Callable[[], bool] = lambda: False,
) -> Cloud:
    """Build the cloud of what does not move with about one point per pixel.

    Of the points in a voxel the one that was seen from nearest is kept as it is, not their mean: averaging blurs what
    is written on things. Voxels are the footprint of a pixel at the usual depth, and grow until the cloud has no more
    than ``max_points``.

    Args:
        sequence: Images, and masks if there are any.
        depths: T maps (H, W), meters, NaN where missing.
        confidence: T maps (H, W), the probability that they are right to 3 %; None where it is not known.
        result: Cameras.
        fusion: Edge threshold and least confidence.
        max_points: Most points of the cloud.
        max_frames: Most frames used, evenly spread.
        should_stop: Asked between frames; the cloud so far is returned then.
    """
    nothing = _Seen(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32))
    step = max(1, -(-result.num_frames // max_frames))
    frames = range(0, result.num_frames, step)
    least = 0.0 if confidence is None else least_confidence(confidence, frames, fusion.cloud_confidence)
    voxel = _footprint(depths, result)
    kept, waiting = nothing, nothing
    for frame in frames:
        if should_stop():
            break
        waiting = waiting.and_of(_lifted(sequence, depths, confidence, result, frame, fusion, least))
        if len(waiting.points) > _POINTS_BETWEEN_MERGES:
            kept, waiting = kept.and_of(waiting).nearest_per_voxel(voxel), nothing
    kept = kept.and_of(waiting).nearest_per_voxel(voxel)
    while len(kept.points) > max_points:
        voxel *= _COARSER
        kept = kept.nearest_per_voxel(voxel)
    return Cloud(kept.points.astype(np.float64), kept.colors)


def _lifted(
    sequence: Sequence | Video,
    depths: FrameSource[Float32Array],
    confidence: FrameSource[Float32Array] | None,
    result: Reconstruction,
    frame: int,
    fusion: FusionConfig,
    least: float,
) -> _Seen:
    depth = depths[frame]
    keep = ~depth_edges(depth, fusion.edge_relative_gradient)
    if confidence is not None:
        keep &= confidence[frame] >= least
    if sequence.masks is not None:
        keep &= ~dilate(sequence.masks[frame] > 0, _BAND_PX)
    pose = result.world_T_cam[frame]
    points, colors = lift(sequence.images[frame], depth, keep, result.frame_intrinsics[frame], pose, 1, result.lens)
    along = (points - pose[:3, 3]) @ pose[:3, 2]
    return _Seen(points.astype(np.float32), colors, along.astype(np.float32))


def _footprint(depths: FrameSource[Float32Array], result: Reconstruction) -> float:
    """Return the size of a pixel at the usual depth, meters."""
    middle = depths[result.num_frames // 2][::4, ::4]
    known = middle[np.isfinite(middle) & (middle > 0.0)]
    depth = float(np.percentile(known, _USUAL_DEPTH_PERCENTILE)) if len(known) else 1.0
    return max(depth / float(np.median(result.frame_intrinsics[:, 0])), 1e-6)
