"""How well the cameras determine the depth of each landmark: near the direction of motion they hardly do."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors.projection import chain_to_world_point, projection_derivatives
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.pipeline.steps import Arrays
from uni4d_fg.slam.stages.scene import StaticNoise

_LEAST_SIGMA = 0.004
"""Landmarks that are known this well all count alike: standard deviation of log depth."""
_WORSE = 4.0
"""And so do those that are worse than the median one by less than this."""
_TOGETHER = 20.0
"""Errors of landmarks over those of independent observations: 12 to 30 on eight rendered clips and a recording."""
_LARGEST = 1.0
"""Of the logarithm of depth that nothing tells."""


def landmark_shares(labelled: LabelledTracks, scene: Arrays, variance: FloatArray) -> FloatArray:
    """Return what part of its weight each landmark (L,) has, 0 to 1, by how sure its depth is beside that of others.

    Where the camera shows parallax of some landmarks only, those of the others follow the noise of their tracks. Where
    it shows none, all are alike, and all have their whole weight.

    Args:
        labelled: Observations.
        scene: Record of stage 2.
        variance: (L,) :func:`variance_of_rays`.
    """
    if not len(variance):
        return np.zeros(0)
    # Landmarks also know what the cue says in all of their frames.
    seen = np.count_nonzero(labelled.weight[scene["landmark_track"]] > 0, axis=1)
    of_cue = seen / max(StaticNoise.of_array(scene["noise"]).depth_sigma, 1e-6) ** 2
    sigma = 1 / np.sqrt(1 / np.maximum(variance, 1e-12) + of_cue)
    shares: FloatArray = np.minimum(max(_LEAST_SIGMA, _WORSE * float(np.median(sigma))) / sigma, 1.0) ** 2
    return shares


def common_sigma(variance: FloatArray) -> float:
    """Return by how much depth is off that is made of landmarks alone, a standard deviation of its logarithm.

    Tracks err alike for as long as they last, and beside each other: the errors of the landmarks are far larger than if
    every observation had noise of its own.

    Args:
        variance: (L,) :func:`variance_of_rays`.
    """
    if not len(variance):
        return _LARGEST
    return min(_TOGETHER * float(np.sqrt(np.median(variance))), _LARGEST)


def variance_of_rays(labelled: LabelledTracks, scene: Arrays, intrinsics: FloatArray) -> FloatArray:
    """Return the variance of the log depth of each landmark (L,) as its rays tell it, with observations independent.

    Args:
        labelled: Observations.
        scene: Record of stage 2.
        intrinsics: (T, 4) px.
    """
    points: FloatArray = scene["landmarks"]
    poses: FloatArray = scene["world_T_cam"]
    if not len(points):
        return np.zeros(0)
    weight = labelled.weight[scene["landmark_track"]] > 0
    information = np.zeros((len(points), 3, 3))
    for frame, pose in enumerate(poses):
        seen = np.flatnonzero(weight[:, frame])
        x = world_to_camera(np.broadcast_to(pose, (len(seen), 4, 4)), points[seen])
        seen, x = seen[x[:, 2] > 0], x[x[:, 2] > 0]
        by_x, _ = projection_derivatives(np.broadcast_to(intrinsics[frame], (len(x), 4)), x)
        jacobian = chain_to_world_point(by_x, np.broadcast_to(pose, (len(x), 4, 4)))
        information[seen] += np.swapaxes(jacobian, 1, 2) @ jacobian
    noise = StaticNoise.of_array(scene["noise"])
    first = np.argmax(weight, axis=1)
    away = points - poses[first, :3, 3]
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    information /= noise.reprojection_sigma_px**2
    information += np.eye(3) * 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None]
    information[np.trace(information, axis1=1, axis2=2) <= 0] = np.eye(3)
    toward = away / distance[:, None]
    variance: FloatArray = np.einsum("li,lij,lj->l", toward, np.linalg.inv(information), toward) / distance**2
    return variance
