"""What to distrust in solved cameras and landmarks; the same for batch, windows and streams."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray

_MAX_FOCAL_CHANGE = 0.15
_MIN_BASELINE = 0.01
"""Of the scene's depth."""


def scene_warnings(
    given_intrinsics: FloatArray, intrinsics: FloatArray, world_T_cam: FloatArray, landmarks: FloatArray
) -> list[str]:
    """Return one sentence for everything that makes a static scene doubtful.

    Args:
        given_intrinsics: (4,) fx, fy, cx, cy, px, that the solve started from.
        intrinsics: (4,) that it ended with.
        world_T_cam: (T, 4, 4) poses.
        landmarks: (N, 3) world, meters.
    """
    warnings = []
    change = float(np.abs(intrinsics[:2] / given_intrinsics[:2] - 1.0).max())
    if change > _MAX_FOCAL_CHANGE:
        warnings.append(f"the focal lengths moved by {100 * change:.0f} % from the given ones")
    if not len(landmarks):
        return [*warnings, "there are no landmarks: the cameras rest on nothing that was measured"]
    first = world_T_cam[0, :3, 3]
    baseline = float(np.linalg.norm(world_T_cam[:, :3, 3] - first, axis=1).max())
    depth = float(np.median(np.linalg.norm(landmarks - first, axis=1)))
    if baseline < _MIN_BASELINE * depth:
        warnings.append(
            f"the camera moves by only {100 * baseline / depth:.2f} % of the scene's depth: "
            "depth comes from the cue alone, and the focal length is poorly determined"
        )
    return warnings
