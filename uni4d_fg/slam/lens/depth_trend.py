"""How a depth cue departs from landmarks toward the corners of the image."""

from __future__ import annotations

import numpy as np

from uni4d_fg.geometry.camera import seen_from
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.scene import StaticScene

_FAR_OFF = 0.5
"""Logarithm of depth beyond which an observation is none of the surface that its cue is of."""
_EXACT = 1e-3
"""Noise of depth below which weights need not tell more from less: exact depth would leave none of any weight."""
_ROUNDS = 5
"""Solves with weights by the residuals of the one before; the scale settles in three."""


def depth_trend(scene: StaticScene, image_size: tuple[int, int]) -> float:
    """Return by how much the depth cue grows, against the landmarks' depth, from the image's center to its corners.

    A pinhole fitted to the images of a lens makes up for it by bending cameras and points: the cue, which is of the
    true scene, then departs from them with the distance from the principal point. What each frame's scale does is left
    out.

    Args:
        scene: Of a pinhole.
        image_size: (height, width), px.

    Returns:
        Of the logarithm of depth, as a straight line in the squared distance has it; 0 without depth.
    """
    seen = scene.observations
    _, row = seen.rows()
    z = seen_from(scene.cameras.world_T_cam, seen.frame, scene.landmarks[row])[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.log(seen.depth / z)
    known = np.flatnonzero(np.abs(off) < _FAR_OFF)
    if len(known) == 0:
        return 0.0
    off, frame = off[known], seen.frame[known]
    corner = 0.25 * (image_size[0] ** 2 + image_size[1] ** 2)
    distance = np.sum((seen.uv[known] - scene.cameras.intrinsics[2:]) ** 2, axis=1) / corner
    weight, slope = np.ones(len(known)), 0.0
    for _ in range(_ROUNDS):
        total = np.maximum(np.bincount(frame, weight), 1e-300)
        across = distance - (np.bincount(frame, weight * distance) / total)[frame]
        depart = off - (np.bincount(frame, weight * off) / total)[frame]
        slope = float(np.sum(weight * depart * across) / max(np.sum(weight * across**2), 1e-300))
        residual = depart - slope * across
        sigma = max(robust_sigma(residual), _EXACT)
        weight = 1.0 / (1.0 + (residual / (2.0 * sigma)) ** 2)
    return slope
