"""Points that other frames saw, where a frame follows none of its own.

A wall that darkens, or leaves the picture, loses its tracks before it is out of sight. What was triangulated of it
holds in every frame, also beyond the borders of the image, between which and the last points depth is interpolated.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, FloatArray, Int32Array, at_nearest_pixel, rows_by_group
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.interpolated_depth import SparseInverseDepth, supported
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.geometry.camera import NEAR_PLANE, project, world_to_camera
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

_MARGIN = 0.3
"""Points this far outside of the image are used, in parts of its longer side."""
_GAP = 0.05
"""And those that are at least this far from the frame's own."""
_HIDDEN = 0.9
"""What has less inverse depth than this part of that of the nearest point of the frame is behind it."""
_BESIDE = 0.03
"""What is this near to a mask (in parts of the longer side) in most of its frames may belong to what moves, and have
stood still while it was followed."""
_AROUND, _BEFORE = 8, 2
"""Of so many nearest others, so many that are nearer hide a point if they are ..."""
_MUCH_NEARER = 1.6
"""... by this factor: less is a surface seen at an angle."""


def beside_masks(masks: FrameSource[Int32Array], observations: Observations, num_tracks: int) -> BoolArray:
    """Return which tracks (K,) are mostly beside something that moves.

    Args:
        masks: T maps (H, W), 0 static.
        observations: At real pixels, inside of the images.
        num_tracks: K.
    """
    beside = np.zeros(num_tracks, dtype=np.int64)
    for mask, mine in zip(masks, rows_by_group(observations.frame, len(masks)), strict=True):
        if not mask.any():
            continue
        size = 2 * round(_BESIDE * max(mask.shape)) + 1
        near = cv2.dilate((mask > 0).astype(np.uint8), np.ones((size, size), np.uint8))
        beside[observations.track[mine[at_nearest_pixel(near, observations.uv[mine]) > 0]]] += 1
    return np.asarray(2 * beside > np.bincount(observations.track, minlength=num_tracks))


def with_borrowed(
    points: SparseInverseDepth, positions: FloatArray, world_T_cam: FloatArray, camera: CameraModel, frame: int,
    image_size: tuple[int, int], config: GeometricDepthConfig,
) -> SparseInverseDepth:  # fmt: skip
    """Add points of the scene to those of a frame, where it has none and they are not hidden.

    Args:
        points: Of the frame; at least one.
        positions: (M, 3) world, of points that can be relied on.
        world_T_cam: (4, 4) of the frame.
        camera: Intrinsics, lens and zoom.
        frame: Its number.
        image_size: (height, width), px.
        config: How many neighbors at a similar depth a point needs.
    """
    gap, margin = _GAP * max(image_size), _MARGIN * max(image_size)
    x = world_to_camera(world_T_cam, positions)
    x = x[x[:, 2] > NEAR_PLANE]
    ideal, inverse, frames = project(camera.intrinsics, x), 1.0 / x[:, 2], np.full(len(x), frame)
    uv = camera.real(ideal, frames)
    height, width = image_size
    with np.errstate(invalid="ignore"):
        inside = ((uv > -margin) & (uv < (width + margin, height + margin))).all(axis=1)
        if not camera.lens.is_pinhole:
            # Far outside of the image, the polynomial of a lens folds back into it.
            inside &= (np.abs(camera.ideal(uv, frames) - ideal) < 1.0).all(axis=1)
    uv, inverse = uv[inside], inverse[inside]
    distance, nearest = cKDTree(points.uv).query(uv)
    shown = (distance > gap) & (inverse > _HIDDEN * points.inverse_depth[nearest])
    uv, inverse = uv[shown], inverse[shown]
    if len(uv) <= _AROUND:
        return points
    apart, around = cKDTree(uv).query(uv, k=_AROUND + 1)
    nearer = (inverse[around] > _MUCH_NEARER * inverse[:, None]) & (apart < gap)
    kept = (np.count_nonzero(nearer, axis=1) < _BEFORE) & supported(uv, inverse, config)
    return SparseInverseDepth(
        np.concatenate((points.uv, uv[kept])), np.concatenate((points.inverse_depth, inverse[kept]))
    )
