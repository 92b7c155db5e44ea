"""Whether the depth of different frames describes one static scene."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, Int32Array
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.slam.reconstruction import Reconstruction

_SAMPLES_ACROSS = 96


def depth_disagreement(
    depths: FrameSource[Float32Array],
    result: Reconstruction,
    masks: FrameSource[Int32Array] | None,
    pairs: list[tuple[int, int]],
    log_scale: FloatArray | None = None,
) -> FloatArray:
    """Return by how much depth differs that is carried from one frame to another by the cameras.

    Static pixels on a grid of one frame are lifted, projected into the other, and compared with its depth there
    (nearest pixel). What is hidden there differs as well; read medians, not means.

    Args:
        depths: T maps (H, W), meters, NaN where missing.
        result: Cameras and lens.
        masks: T label maps (H, W), 0 static; None where nothing moves.
        pairs: Frames to carry from and to.
        log_scale: (T,) logarithm of a factor on each frame's depth.

    Returns:
        (N,) ``|log(carried / found)|``: for small values the relative difference.
    """
    height, width = result.image_size
    step = max(1, width // _SAMPLES_ACROSS)
    v, u = np.mgrid[step // 2 : height : step, step // 2 : width : step].reshape(2, -1)
    real = np.stack((u, v), axis=1).astype(np.float64)
    factor = np.ones(result.num_frames) if log_scale is None else np.exp(log_scale)
    found = [np.zeros(0)]
    for here, there in pairs:
        depth = factor[here] * np.asarray(depths[here])[v, u].astype(np.float64)
        keep = np.isfinite(depth) & (depth > 0)
        if masks is not None:
            keep &= np.asarray(masks[here])[v, u] == 0
        first, second = result.frame_intrinsics[here], result.frame_intrinsics[there]
        camera = unproject(first, result.lens.ideal_pixels(first, real[keep]), depth[keep])
        world = camera_to_world(result.world_T_cam[here], camera)
        carried = world_to_camera(result.world_T_cam[there], world)
        carried = carried[np.isfinite(carried).all(axis=1) & (carried[:, 2] > 0)]
        pixel = result.lens.real_pixels(second, project(second, carried))
        inside = np.isfinite(pixel).all(axis=1)
        inside &= (pixel > -0.5).all(axis=1) & (pixel < np.array([width, height]) - 0.5).all(axis=1)
        column, row = np.rint(pixel[inside]).astype(np.int64).T
        other = factor[there] * np.asarray(depths[there])[row, column].astype(np.float64)
        known = np.isfinite(other) & (other > 0)
        if masks is not None:
            known &= np.asarray(masks[there])[row, column] == 0
        found.append(np.abs(np.log(carried[inside][known, 2] / other[known])))
    return np.concatenate(found)
