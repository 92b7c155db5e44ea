"""A first guess of which tracks move, before any cameras are known.

Between frames a few steps apart, the pose that most tracks agree on is found by RANSAC from their depth in one frame
and their pixels in the other. A least-squares solve over all tracks, robust kernels or not, would be drawn towards a
large moving thing; the pose of the majority is not.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, evenly_spread
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.static_scene import predict_static
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.camera import intrinsics_matrix, unproject


def find_outlier_tracks(
    labelled: LabelledTracks, intrinsics: FloatArray, config: MotionMaskConfig, known_moving: BoolArray
) -> BoolArray:
    """Return (K,) the tracks that disagree with the majority between most pairs of frames in which they are seen.

    Args:
        labelled: K tracks with depth; labels and weights are not read.
        intrinsics: (4,) px; roughly right is enough over a few frames.
        config: Its fields ``first_guess_...``.
        known_moving: (K,) tracks that take no part, as a large thing that moves may be the majority.
    """
    num_tracks, num_frames = labelled.tracks.visible.shape
    agreed, tested = np.zeros(num_tracks), np.zeros(num_tracks)
    step = min(config.first_guess_step, num_frames - 1)
    for source in range(num_frames - step) if step else ():
        target = source + step
        seen = labelled.tracks.visible[:, source] & labelled.tracks.visible[:, target] & ~known_moving
        track = np.flatnonzero(seen & np.isfinite(labelled.depth[:, source]))
        if len(track) < config.first_guess_min_tracks:
            continue
        uv, uv_target = (labelled.tracks.uv[track, frame].astype(np.float64) for frame in (source, target))
        depth = labelled.depth[track, source].astype(np.float64)
        pose = _majority_pose(unproject(intrinsics, uv, depth), uv_target, intrinsics, config)
        if pose is None:
            continue
        static = predict_static(uv[:, 0], uv[:, 1], np.log(depth), pose, intrinsics)
        miss = np.hypot(static.u - uv_target[:, 0], static.v - uv_target[:, 1])
        tested[track] += 1
        agreed[track] += miss < config.first_guess_px
    return np.asarray((tested > 0) & (agreed < 0.5 * tested))


def _majority_pose(
    points: FloatArray, uv: FloatArray, intrinsics: FloatArray, config: MotionMaskConfig
) -> FloatArray | None:
    """Return the pose (4, 4) of the points' camera in the one that sees them at ``uv``; None if none is found."""
    thin = evenly_spread(len(points), config.first_guess_max_tracks)
    matrix = intrinsics_matrix(intrinsics)
    try:
        found, rotation, translation, _ = cv2.solvePnPRansac(
            points[thin],
            uv[thin],
            matrix,
            np.zeros(4),
            None,
            None,
            False,
            config.first_guess_trials,
            config.first_guess_px,
            0.999,
        )
    except cv2.error:  # Degenerate points.
        return None
    if not found:
        return None
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotation)[0]
    pose[:3, 3] = np.ravel(translation)
    return pose
