r"""Pairs of landmarks that may be one point: near each other in the image and in the world, never seen together.

With the information of a landmark under given cameras,

    Omega = sum_t  w_t (J_t^T J_t / sigma^2 + d_t d_t^T / sigma_D^2),     d_t = R_t e_z / z_t,

two landmarks are compared by the squared Mahalanobis distance of their difference, whose covariance is the sum of
both inverses and of (z camera_sigma_px / f)^2 I for what the cameras of the two fragments do not agree on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.rejoin import RejoinConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection_jacobian
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.geometry.camera import NEAR_PLANE, project, world_to_camera
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise

_PRIOR_SIGMA_M = 1e3
"""Keeps the information of a point without depth and parallax invertible."""


@dataclass(frozen=True)
class Candidates:
    """P pairs of landmark rows; the first track of a pair starts earlier."""

    earlier: IntArray
    """(P,)."""
    later: IntArray
    """(P,)."""
    distance: FloatArray
    """(P,) squared Mahalanobis distance of their positions."""

    def __len__(self) -> int:
        return len(self.earlier)

    def select(self, keep: BoolArray | IntArray) -> Candidates:
        """Return the pairs picked by a mask or by indices."""
        return Candidates(self.earlier[keep], self.later[keep], self.distance[keep])


def find_candidates(state: State, observations: Observations, noise: StaticNoise, config: RejoinConfig) -> Candidates:
    """Return the pairs that geometry allows.

    Args:
        state: Solved cameras and N landmarks, ascending by track.
        observations: Their observations.
        noise: Measured noise of reprojection and depth.
        config: Distances.
    """
    pairs = _near_in_the_image(state, observations, config.max_distance_px)
    pairs = pairs[~_seen_together(observations, pairs)]
    earlier, later = pairs[:, 0], pairs[:, 1]
    difference = state[LANDMARK][later] - state[LANDMARK][earlier]
    tracks, row = observations.rows()
    involved, place = np.unique(pairs, return_inverse=True)
    compared = Cameras.of(state).state(state[LANDMARK][involved], tracks[involved])
    covariance = landmark_covariances(compared, observations.select(np.isin(row, involved)), noise)
    covariance = covariance[place.reshape(-1, 2)]
    first = observations.frame[np.searchsorted(row, later)]
    z = world_to_camera(state[POSE][first], state[LANDMARK][later])[:, 2]
    slack = (np.maximum(z, NEAR_PLANE) * config.camera_sigma_px / state[INTRINSICS][0, 0]) ** 2
    spread = covariance.sum(axis=1) + slack[:, None, None] * np.eye(3)
    distance = np.einsum("pi,pi->p", difference, np.linalg.solve(spread, difference[:, :, None])[:, :, 0])
    return Candidates(earlier, later, distance).select(distance <= config.max_sigmas**2)


def landmark_covariances(state: State, observations: Observations, noise: StaticNoise) -> FloatArray:
    """Return the covariance (N, 3, 3), m^2, of every landmark under the given cameras."""
    tracks, row = observations.rows()
    pose, landmark = state[POSE][observations.frame], state[LANDMARK][row]
    intrinsics = np.broadcast_to(state[INTRINSICS], (len(row), 4))
    _, (_, jacobian, _) = static_reprojection_jacobian(pose, landmark, intrinsics, uv=observations.uv)
    weight = observations.weight / noise.reprojection_sigma_px**2
    information = np.einsum("nai,naj,n->nij", jacobian, jacobian, weight)
    z = np.maximum(world_to_camera(pose, landmark)[:, 2], NEAR_PLANE)
    axis = pose[:, :3, 2] / z[:, None]
    sigma = noise.effective_depth_sigma(len(observations) / max(len(tracks), 1))
    known = np.where(np.isfinite(observations.depth), observations.weight / sigma**2, 0.0)
    information += np.einsum("ni,nj,n->nij", axis, axis, known)
    total = np.zeros((len(tracks), 3, 3))
    np.add.at(total, row, information)
    return np.asarray(np.linalg.inv(total + np.eye(3) / _PRIOR_SIGMA_M**2), dtype=np.float64)


def _near_in_the_image(state: State, observations: Observations, radius_px: float) -> IntArray:
    """Return pairs (P, 2) that project near each other in the frame in which the later track starts."""
    from scipy.spatial import cKDTree

    tracks, row = observations.rows()
    first = observations.frame[np.searchsorted(row, np.arange(len(tracks)))]
    found = [np.zeros((0, 2), np.int64)]
    for frame in np.unique(first)[1:]:
        older, newer = np.flatnonzero(first < frame), np.flatnonzero(first == frame)
        uv, z = _projected(state, frame, older)
        older, uv = older[z > NEAR_PLANE], uv[z > NEAR_PLANE]
        near = cKDTree(uv).query_ball_point(_projected(state, frame, newer)[0], radius_px)
        count = np.array([len(n) for n in near], np.int64)
        which = np.concatenate([np.asarray(n, np.int64) for n in near])
        found.append(np.stack((older[which], np.repeat(newer, count)), axis=1))
    return np.concatenate(found)


def _projected(state: State, frame: int, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    x = world_to_camera(state[POSE][frame], state[LANDMARK][rows])
    return np.asarray(project(state[INTRINSICS][0], x)), x[:, 2]


def _seen_together(observations: Observations, pairs: IntArray) -> BoolArray:
    """Return which pairs (P, 2) of landmark rows have observations in a common frame, (P,)."""
    tracks, row = observations.rows()
    start = np.searchsorted(row, np.arange(len(tracks) + 1))
    frames = 1 + int(observations.frame.max(initial=0))
    key = row * frames + observations.frame
    count = (start[1:] - start[:-1])[pairs[:, 0]]
    pair = np.repeat(np.arange(len(pairs)), count)
    within = np.arange(len(pair)) - np.repeat(np.cumsum(count) - count, count)
    wanted = pairs[pair, 1] * frames + observations.frame[start[pairs[pair, 0]] + within]
    position = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    together = np.zeros(len(pairs), np.bool_)
    together[pair[key[position] == wanted]] = True
    return together
