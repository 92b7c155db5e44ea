"""What exports for splats and artists share: clouds with normals, and which pixels are hidden."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from uni4d_fg.geometry.camera import camera_to_world, unproject
from uni4d_fg.results.export.clouds import static_cloud
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.results.fusion.clouds import depth_edges, dilate
from uni4d_fg.results.nearest import from_nearest
from uni4d_fg.results.normals import cloud_normals, normal_map
from uni4d_fg.results.run import Run

MASK_MARGIN_PX = 3
"""Width of the band around moving things that is hidden with them, px at 640 px of image width."""
NORMAL_FRAMES = 30
"""Frames whose depth gives the normals of the static cloud, at most."""


class CloudWithNormals(NamedTuple):
    """A colored cloud whose points know which way their surface faces."""

    points: FloatArray
    """(N, 3) world, meters."""
    colors: ImageArray
    """(N, 3) RGB."""
    normals: FloatArray
    """(N, 3) unit vectors in world axes, towards the cameras."""


def static_cloud_with_normals(job: ExportJob) -> CloudWithNormals:
    """Return the static cloud of a run of a pinhole; errors as in :func:`~uni4d_fg.results.export.run.export_run`."""
    run, result = job.run, job.run.reconstruction
    cloud = static_cloud(run)
    stride = max(1, -(-run.num_frames // NORMAL_FRAMES))
    depth = run.depth
    maps = ((frame, depth[frame]) for frame in range(0, run.num_frames, stride)) if depth is not None else ()
    normals = cloud_normals(cloud.points, maps, result.frame_intrinsics, result.world_T_cam)
    return CloudWithNormals(cloud.points, cloud.colors, normals)


def every_moving_pixel(run: Run, frame: int) -> CloudWithNormals:
    """Return what moves in one frame of a run of a pinhole, a point for every pixel; depth edges are left out.

    Raises:
        InputError: If the sequence or the dense depth is missing.
    """
    sequence, depth = run.need_sequence(), run.need_depth("a point for every pixel")[frame]
    edges = depth_edges(depth, run.config.fusion.edge_relative_gradient)
    with np.errstate(invalid="ignore"):
        keep = (sequence.masks[frame] > 0) & ~edges & np.isfinite(depth) & (depth > 0.0)
    v, u = np.nonzero(keep)
    pose, camera = run.reconstruction.world_T_cam[frame], run.reconstruction.frame_intrinsics[frame]
    local = unproject(camera, np.stack((u, v), axis=-1).astype(np.float64), depth[v, u].astype(np.float64))
    facing = normal_map(depth, camera)[v, u].astype(np.float64)
    # Alone in its window, a point faces the camera.
    blank = ~np.isfinite(facing).all(axis=1)
    facing[blank] = -local[blank] / np.linalg.norm(local[blank], axis=1, keepdims=True)
    return CloudWithNormals(camera_to_world(pose, local), sequence.images[frame][v, u], facing @ pose[:3, :3].T)


def hidden_pixels(run: Run, frame: int) -> BoolArray:
    """Return the pixels (H, W) of a frame that show what moves, and a band around it where colors mix."""
    mask = run.need_sequence().masks[frame] > 0
    return dilate(mask, max(1, round(MASK_MARGIN_PX * mask.shape[1] / 640)))


def without_holes(inverse_depth: Float32Array, known: BoolArray) -> Float32Array:
    """Give every pixel that is not known the value of the nearest one (H, W) that is; 0 where none is."""
    if not known.any():
        return np.zeros(known.shape, np.float32)
    return from_nearest(inverse_depth, known).astype(np.float32)
