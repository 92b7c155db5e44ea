"""Colored point clouds from images, fused depth and poses: one static, one dynamic per frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray, Int32Array, evenly_spread
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.geometry.camera import camera_to_world, unproject
from uni4d_fg.geometry.lens import PINHOLE, Lens

_POINTS_BETWEEN_MERGES = 2_000_000
_SAMPLED, _SAMPLED_FRAMES = 4, 24
"""Of confidence, every this many pixels of at most so many frames tell how much of it there is."""
_TO_SPEAK_OF = 0.001
"""Part of the pixels that are to be sure, so that only they are taken."""


class Cloud(NamedTuple):
    """A colored point cloud."""

    points: FloatArray
    """(N, 3) world positions, meters."""
    colors: ImageArray
    """(N, 3) RGB."""


def static_cloud(
    images: FrameSource[ImageArray],
    depths: FrameSource[Float32Array],
    masks: FrameSource[Int32Array],
    intrinsics: FloatArray,
    world_T_cam: FloatArray,
    config: FusionConfig,
    *,
    confidence: FrameSource[Float32Array] | None = None,
    band_px: int = 5,
    lens: Lens = PINHOLE,
) -> Cloud:
    """Build the cloud of everything that does not move, over the whole video.

    Pixels of moving instances, a band around them, and pixels at depth edges are left out, and so are those that are
    not sure, as other frames see through them or past them: where next to none are sure in the whole video, as its
    camera hardly moves, the less sure half of them. Points that share
    a voxel are averaged; merging goes on while frames are read, so that memory does not grow with the video.

    Args:
        images: T images (H, W, 3), RGB.
        depths: T maps (H, W), meters, NaN where missing.
        masks: T label maps (H, W), 0 static.
        intrinsics: (4,) fx, fy, cx, cy, px, or (T, 4) of each frame.
        world_T_cam: (T, 4, 4) camera to world, meters.
        config: Strides, voxel size, edge threshold and least confidence.
        confidence: T maps (H, W), the probability that depth is right to 3 %; None where it is not known.
        band_px: Width of the band around instances, px.
        lens: Distortion of the images.

    Raises:
        InputError: If the maps of a frame differ in size.
    """
    parts: list[Cloud] = []
    waiting = 0
    cameras = np.broadcast_to(intrinsics, (len(images), 4))
    frames = range(0, len(images), config.static_frame_stride)
    least = 0.0 if confidence is None else least_confidence(confidence, frames, config.cloud_confidence)
    for frame in frames:
        image, depth, mask = _maps(frame, images, depths, masks)
        keep = ~dilate(mask > 0, band_px) & ~depth_edges(depth, config.edge_relative_gradient)
        if confidence is not None:
            keep &= confidence[frame] >= least
        part = lift(image, depth, keep, cameras[frame], world_T_cam[frame], config.static_stride, lens)
        parts.append(part)
        waiting += len(part.points)
        if waiting > _POINTS_BETWEEN_MERGES and config.static_voxel_m > 0.0:
            parts, waiting = [merge_voxels(_concatenate(parts), config.static_voxel_m)], 0
    return merge_voxels(_concatenate(parts), config.static_voxel_m)


def least_confidence(confidence: FrameSource[Float32Array], frames: range, wanted: float) -> float:
    """Return from which confidence on pixels are taken: the one that is wanted, if that leaves any to speak of.

    Args:
        confidence: T maps (H, W).
        frames: Those of which pixels are taken.
        wanted: Of the config.
    """
    some = [frames[place] for place in evenly_spread(len(frames), _SAMPLED_FRAMES).tolist()]
    sampled = np.concatenate([confidence[frame][::_SAMPLED, ::_SAMPLED].ravel() for frame in some])
    known = sampled[sampled > 0]
    if not len(known) or np.mean(known >= wanted) >= _TO_SPEAK_OF:
        return wanted
    return float(np.median(known))


def dynamic_clouds(
    images: FrameSource[ImageArray],
    depths: FrameSource[Float32Array],
    masks: FrameSource[Int32Array],
    intrinsics: FloatArray,
    world_T_cam: FloatArray,
    config: FusionConfig,
    lens: Lens = PINHOLE,
) -> Iterator[Cloud]:
    """Yield the cloud of the moving instances of each frame in turn; arguments as in :func:`static_cloud`."""
    cameras = np.broadcast_to(intrinsics, (len(images), 4))
    for frame in range(len(images)):
        image, depth, mask = _maps(frame, images, depths, masks)
        yield dynamic_cloud(image, depth, mask, cameras[frame], world_T_cam[frame], config, lens)


def dynamic_cloud(
    image: ImageArray,
    depth: Float32Array,
    mask: Int32Array,
    intrinsics: FloatArray,
    world_T_cam: FloatArray,
    config: FusionConfig,
    lens: Lens = PINHOLE,
) -> Cloud:
    """Return the cloud of the moving instances of one frame; depth edges are left out."""
    keep = (mask > 0) & ~depth_edges(depth, config.edge_relative_gradient)
    return lift(image, depth, keep, intrinsics, world_T_cam, config.dynamic_stride, lens)


def lift(
    image: ImageArray,
    depth: Float32Array,
    keep: BoolArray,
    intrinsics: FloatArray,
    world_T_cam: FloatArray,
    stride: int,
    lens: Lens = PINHOLE,
) -> Cloud:
    """Lift every ``stride``-th pixel (in x and y) that is kept, has depth and a direction, into the world."""
    chosen = np.zeros(depth.shape, dtype=bool)
    chosen[::stride, ::stride] = True
    with np.errstate(invalid="ignore"):
        chosen &= keep & np.isfinite(depth) & (depth > 0.0)
    v, u = np.nonzero(chosen)
    uv = lens.ideal_pixels(intrinsics, np.stack((u, v), axis=-1).astype(np.float64))
    seen = np.isfinite(uv).all(axis=1)
    u, v, uv = u[seen], v[seen], uv[seen]
    points = camera_to_world(world_T_cam, unproject(intrinsics, uv, depth[v, u].astype(np.float64)))
    return Cloud(points, image[v, u])


def depth_edges(depth: Float32Array, relative_gradient: float) -> BoolArray:
    """Return the pixels (H, W) whose depth differs from a neighbor's by more than this part of the smaller one.

    Both pixels of a pair are marked: depth that mixes two surfaces may lie on either side of the edge.
    """
    edges = np.zeros(depth.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        for first, second in (
            ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
            ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
        ):
            a, b = depth[first], depth[second]
            jump = np.abs(a - b) > relative_gradient * np.minimum(a, b)
            edges[first] |= jump
            edges[second] |= jump
    return edges


def dilate(mask: BoolArray, radius_px: int) -> BoolArray:
    """Return the pixels within ``radius_px`` of a set pixel."""
    if radius_px <= 0:
        return mask
    side = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)


def merge_voxels(cloud: Cloud, voxel_m: float) -> Cloud:
    """Average positions and colors within cubes of side ``voxel_m``, in the order of the cubes; 0 keeps every point.

    The cubes are those of Open3D's ``voxel_down_sample``, which loading alone takes many times as long as this.
    """
    if voxel_m <= 0.0 or len(cloud.points) == 0:
        return cloud
    cell = np.floor((cloud.points - (cloud.points.min(axis=0) - 0.5 * voxel_m)) / voxel_m).astype(np.int64)
    size = cell.max(axis=0) + 1
    if np.prod(size.astype(np.float64)) < 2.0**62:
        _, index = np.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_inverse=True)
    else:
        _, index = np.unique(cell, axis=0, return_inverse=True)
    count = np.bincount(index)
    points, colors = (
        np.stack([np.bincount(index, values[:, axis]) / count for axis in range(3)], axis=1)
        for values in (cloud.points, cloud.colors)
    )
    return Cloud(points, np.clip(np.rint(colors), 0, 255).astype(np.uint8))


def _concatenate(parts: list[Cloud]) -> Cloud:
    if not parts:
        return Cloud(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))
    return Cloud(np.concatenate([p.points for p in parts]), np.concatenate([p.colors for p in parts]))


def _maps(
    frame: int,
    images: FrameSource[ImageArray],
    depths: FrameSource[Float32Array],
    masks: FrameSource[Int32Array],
) -> tuple[ImageArray, Float32Array, Int32Array]:
    image, depth, mask = images[frame], depths[frame], masks[frame]
    if not image.shape[:2] == depth.shape == mask.shape:
        raise InputError(
            f"clouds: frame {frame}: image {image.shape[:2]}, depth {depth.shape} and mask {mask.shape} "
            "must have one size"
        )
    return image, depth, mask
