"""How exactly the position of each camera is known from the static points that it sees.

As if each pose were found by itself, from points that are known: then the errors of frames are independent, which is
what moves cameras from one frame to the next where nobody did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray, evenly_spread
from uni4d_fg.factors.static_reprojection import static_reprojection_jacobian
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.robust import MEDIAN_OF_NORM

_MOST_POINTS = 1000
"""Points of a frame that are looked at: more would say no more, as those beside each other err alike."""
_FEWEST_POINTS = 6
_SOFT = 2.0
"""Errors, in standard deviations, from which on a point counts less than half."""


@dataclass(frozen=True)
class CameraNoise:
    """Errors of cameras that are independent from frame to frame."""

    covariance: FloatArray
    """(T, 3, 3) of the positions, in the world's unit squared; infinite on the diagonal where too little is seen."""
    inverse_depth: float
    """Of the static scene: a pose that is wrong in position turns so that points there are where they were seen."""

    @classmethod
    def of_points(
        cls, track: IntArray, points: FloatArray, tracks: Tracks, world_T_cam: FloatArray, intrinsics: FloatArray
    ) -> CameraNoise:
        """Measure them.

        Args:
            track: (M,) tracks of static points.
            points: (M, 3) world; NaN where there is none.
            tracks: At the pixels of a pinhole.
            world_T_cam: (T, 4, 4).
            intrinsics: (4,) px.
        """
        known = np.isfinite(points).all(axis=1)
        track, points = track[known], points[known]
        covariance, inverse = np.full((len(world_T_cam), 3, 3), np.inf), [np.zeros(0)]
        for frame, pose in enumerate(world_T_cam):
            seen = np.flatnonzero(tracks.visible[track, frame])
            some = seen[evenly_spread(len(seen), _MOST_POINTS)]
            uv = tracks.uv[track[some], frame].astype(np.float64)
            at = np.broadcast_to(pose, (len(some), 4, 4)), points[some], np.broadcast_to(intrinsics, (len(some), 4))
            residual, (by_pose, *_) = static_reprojection_jacobian(*at, uv=uv)
            depth = world_to_camera(*at[:2])[:, 2]
            inverse.append(1.0 / depth[depth > 0])
            if len(some) < _FEWEST_POINTS:
                continue
            off = np.linalg.norm(residual, axis=1)
            sigma = max(float(np.median(off)) / MEDIAN_OF_NORM, 1e-6)
            weight = 1.0 / (1.0 + (off / (_SOFT * sigma)) ** 2)
            information = np.einsum("n,nki,nkj->ij", weight, by_pose, by_pose)
            try:
                in_camera = sigma**2 * np.linalg.inv(information)[3:, 3:]
            except np.linalg.LinAlgError:
                continue
            covariance[frame] = pose[:3, :3] @ in_camera @ pose[:3, :3].T
        depths = np.concatenate(inverse)
        return cls(covariance, float(np.median(depths)) if len(depths) else 0.0)
