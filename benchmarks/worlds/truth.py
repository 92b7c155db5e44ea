"""What is true of a clip: cameras, depth and masks of the middle of each exposure; and whether images agree."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.worlds.film import Filming, may_move, pixel_rays
from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray

_KEPT_BITS = 13
"""Bits of depth's mantissa that are stored (0.006 %): the others are zero, which packs better."""


@dataclass(frozen=True)
class FrameTruth:
    """One frame at the middle of its exposure, through the centers of pixels."""

    world_T_cam: FloatArray
    """(4, 4) meters."""
    depth: Float32Array
    """(H, W) z-depth, meters, 0 where the sky is seen."""
    moving: BoolArray
    """(H, W) True on things that move around this time."""
    instance: ImageArray
    """(H, W) number of the moving thing, 0 on what stands still."""
    moves: BoolArray
    """(1 + things,) True for those that move around this time."""


def _rounded(depth: Float32Array) -> Float32Array:
    """Return depth rounded to fewer bits."""
    step = np.uint32(1 << (23 - _KEPT_BITS))
    bits = np.ascontiguousarray(depth, dtype=np.float32).view(np.uint32) + step // np.uint32(2)
    return np.asarray((bits & ~(step - np.uint32(1))).view(np.float32))


def frame_truth(filming: Filming, frame: int) -> FrameTruth:
    """Return the truth of a frame."""
    world, stage = filming.world, filming.stage
    time = world.time(frame)
    moment, pose = stage.at(time), world.camera(time)
    meet = stage.cast(moment, pixel_rays(world, pose), may_move(world, pose, moment))
    shape = (world.height, world.width)
    met = meet.triangle >= 0
    depth = _rounded(np.where(met, meet.distance, 0.0).astype(np.float32)).reshape(shape)
    instance = np.where(met, stage.instance[np.maximum(meet.triangle, 0)], 0).astype(np.uint8).reshape(shape)
    moves = stage.moves(time)
    return FrameTruth(pose, depth, moves[instance], instance, moves)


def save(path: Path, filming: Filming, frames: list[FrameTruth]) -> None:
    """Write world_T_cam (T, 4, 4), K (4,), fps, depth, moving and instance (T, H, W) as one .npz."""
    world = filming.world
    ever = np.any([frame.moves for frame in frames], axis=0)
    instance = np.stack([frame.instance for frame in frames])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        world_T_cam=np.stack([frame.world_T_cam for frame in frames]), K=world.intrinsics, fps=np.float64(world.fps),
        depth=np.stack([frame.depth for frame in frames]), moving=np.stack([frame.moving for frame in frames]),
        instance=np.where(ever[instance], instance, 0).astype(np.uint8),
    )  # fmt: skip


def warp_difference(
    images: ImageArray, poses: FloatArray, intrinsics: FloatArray, depth: Float32Array, instance: ImageArray, gap: int
) -> float:
    """Return the median absolute gray difference of static points between frames ``gap`` apart.

    Points of every tenth frame are projected by depth and cameras into a later one. Those near edges of depth, on
    moving things, hidden or outside are left out.

    Args:
        images: (T, H, W, 3) RGB.
        poses: (T, 4, 4) world_T_cam, meters.
        intrinsics: (4,) fx, fy, cx, cy, px.
        depth: (T, H, W) z-depth, meters, 0 for none.
        instance: (T, H, W) 0 where static.
        gap: Frames between the two images.
    """
    fx, fy, cx, cy = intrinsics
    differences = []
    height, width = depth.shape[1:]
    v, u = np.mgrid[:height, :width].astype(np.float64)
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in images]
    for a in range(0, len(images) - gap, 10):
        b = a + gap
        z = depth[a].astype(np.float64)
        point = np.stack(((u - cx) / fx * z, (v - cy) / fy * z, z), axis=-1)
        relative = np.linalg.inv(poses[b]) @ poses[a]
        point = point @ relative[:3, :3].T + relative[:3, 3]
        far = np.maximum(point[..., 2], 1e-6)
        x, y = (fx * point[..., 0] / far + cx).astype(np.float32), (fy * point[..., 1] / far + cy).astype(np.float32)
        seen_z = cv2.remap(depth[b], x, y, cv2.INTER_NEAREST, borderValue=0)
        seen = cv2.remap(gray[b], x, y, cv2.INTER_LINEAR, borderValue=-1)
        other = cv2.remap(instance[b], x, y, cv2.INTER_NEAREST, borderValue=1)
        low, high = (f(depth[a], np.ones((7, 7), np.uint8)) for f in (cv2.erode, cv2.dilate))
        inside = (x > 1) & (x < width - 2) & (y > 1) & (y < height - 2)
        kept = inside & (z > 0) & (high < 1.1 * low) & (instance[a] == 0) & (other == 0)
        kept &= np.abs(seen_z / far - 1) < 0.02
        differences.append(np.abs(seen - gray[a])[kept])
    return float(np.median(np.concatenate(differences)))
