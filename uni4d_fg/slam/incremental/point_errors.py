r"""What the errors of points add to the covariance of a frame that is posed by them.

A frame between keyframes is solved with its points held. With the pose's covariance C given the points, whitened
Jacobians A_k of the reprojection by the pose and B_k by the point, an error e_k of the points moves the pose by

    -C sum_k A_k^T B_k e_k.

Along the ray from the keyframe a point is known by the depth cue and the parallax so far: such errors count as alike
within a cell of the image, as the cue's are, and as independent between cells. Across the ray it is known by as many
pixels as there were views of it: in the first frames by one, as noisy as the new frame's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.slam.association.candidates import landmark_covariances
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise


@dataclass(frozen=True)
class PointErrors:
    """How uncertain n points are."""

    along: FloatArray
    """(n, 3) m, one standard deviation along the ray, away from the camera."""
    across: FloatArray
    """(n, 3, 3) m^2, covariance across the ray."""

    def spread(self, reprojection: FactorBatch, state: State, covariance: FloatArray, cells: IntArray) -> FloatArray:
        """Return what they add to the covariance (6, 6) of a pose.

        Args:
            reprojection: n factors of the pose and a point each.
            state: Where the pose was found.
            covariance: (6, 6) of the pose given the points.
            cells: (n,) numbers from zero of the cells of the image.
        """
        _, (by_pose, by_point, _) = reprojection.linearize(state)
        pull = np.einsum("nda,ndb->nab", by_pose, by_point)
        alike = np.zeros((int(cells.max(initial=0)) + 1, 6))
        np.add.at(alike, cells, (pull @ self.along[:, :, None])[:, :, 0])
        apart = (pull @ self.across @ np.swapaxes(pull, 1, 2)).sum(axis=0)
        result: FloatArray = covariance @ (alike.T @ alike + apart) @ covariance
        return result


def point_errors(
    observations: Observations,
    cameras: Cameras,
    keyframe: int,
    track: IntArray,
    points: FloatArray,
    noise: StaticNoise,
) -> PointErrors:
    """Return how uncertain the points of tracks are, with the cameras held.

    Args:
        observations: Of the keyframes; every track has some.
        cameras: Of the keyframes.
        keyframe: Row of the camera from which rays lead to the points.
        track: (n,) numbers of the tracks, in any order.
        points: (n, 3) world, m.
        noise: Sigmas.
    """
    order = np.argsort(track)
    seen = observations.select(np.isin(observations.track, track))
    covariance = np.empty((len(track), 3, 3))
    covariance[order] = landmark_covariances(cameras.state(points[order], track[order]), seen, noise)
    ray = points - cameras.world_T_cam[keyframe, :3, 3]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    variance = np.einsum("ni,nij,nj->n", ray, covariance, ray)
    flat = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    return PointErrors(ray * np.sqrt(variance)[:, None], flat @ covariance @ flat)
