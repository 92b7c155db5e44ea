r"""Where the fit of a rigid body starts: aligned point sets, chained to the frame that shares most with the others.

Between two frames the motion is the weighted Procrustes alignment of the trajectories that both see,

    min over R, t of  sum_k w_k |R p_{k,a} + t - p_{k,b}|^2,    w_k = 1 / (1 + (e_k / s)^2)

with weights from the errors e_k and their scale s (Cauchy), repeated (Kabsch 1976; Holland and Welsch 1977). Its
variance falls with the number n of common trajectories, so that the best chain of alignments from the reference frame
to any other is the shortest path with lengths 1 / n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import dijkstra

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world, world_to_camera
from uni4d_fg.robust import robust_sigma

_REWEIGHTINGS = 15


@dataclass(frozen=True)
class RigidBody:
    """Poses and shape of one rigid body."""

    world_T_object: FloatArray
    """(T, 4, 4)."""
    points: FloatArray
    """(N, 3) in the object's frame, m."""
    reference: int
    """Frame in which the object's origin is the middle of the points seen, and its axes are the world's."""


def align(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the rigid transform (4, 4) that takes points ``source`` (N, 3) to ``target`` (N, 3), outliers aside."""
    weight = np.ones(len(source))
    transform = np.eye(4)
    for _ in range(_REWEIGHTINGS):
        transform = _weighted_procrustes(source, target, weight)
        error = np.linalg.norm(source @ transform[:3, :3].T + transform[:3, 3] - target, axis=1)
        scale = robust_sigma(error)
        if not scale > 1e-12:
            break
        weight = 1.0 / (1.0 + (error / scale) ** 2)
    return transform


def _weighted_procrustes(source: FloatArray, target: FloatArray, weight: FloatArray) -> FloatArray:
    part = weight / weight.sum()
    middle, goal = part @ source, part @ target
    u, _, vt = np.linalg.svd((target - goal).T @ (part[:, None] * (source - middle)))
    out = np.eye(4)
    out[:3, :3] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    out[:3, 3] = goal - out[:3, :3] @ middle
    return out


def start_rigid_body(points: FloatArray, observed: BoolArray, min_common: int) -> RigidBody | None:
    """Return poses and shape that explain trajectories as well as chained alignments can.

    Args:
        points: (N, T, 3) trajectories, world, m; NaN where unknown.
        observed: (N, T).
        min_common: Two frames with fewer common trajectories are not aligned.

    Returns:
        The body; poses of frames that no chain reaches are interpolated, or those of the nearest frame. None if some
        trajectory is seen in no frame that is reached, or no two frames can be aligned.
    """
    seen = observed & np.isfinite(points).all(axis=2)
    common = seen.T.astype(np.float64) @ seen
    common[common < min_common] = 0.0
    reference = central_frame(seen)
    lengths = np.divide(1.0, common, out=np.zeros_like(common), where=common > 0)
    np.fill_diagonal(lengths, 0.0)
    distance, before = dijkstra(lengths, directed=False, indices=reference, return_predecessors=True)
    if np.isfinite(distance).sum() < 2:
        return None
    poses = np.full((points.shape[1], 4, 4), np.nan)
    poses[reference] = np.eye(4)
    poses[reference, :3, 3] = points[seen[:, reference], reference].mean(axis=0)
    for frame in np.argsort(distance, kind="stable").tolist():
        if frame == reference or not np.isfinite(distance[frame]):
            continue
        both = seen[:, frame] & seen[:, before[frame]]
        motion = align(points[both, before[frame]], points[both, frame])
        poses[frame] = motion @ poses[before[frame]]
    reached = np.isfinite(distance)
    poses = se3.orthonormalize(fill_poses(poses, reached))
    usable = seen & reached
    if not usable.any(axis=1).all():
        return None
    local = world_to_camera(np.broadcast_to(poses, (*points.shape[:2], 4, 4)), points)
    shape = np.nanmedian(np.where(usable[..., None], local, np.nan), axis=1)
    return RigidBody(poses, shape, reference)


def central_frame(seen: BoolArray) -> int:
    """Return the frame in the middle of all observations (N, T), of those that see half as many as the best.

    What drifts between the poses, such as the body's depth against the speed of its turning, is smallest about a frame
    in the middle.
    """
    count = seen.sum(axis=0)
    middle = float(np.median(np.nonzero(seen)[1]))
    well_seen = np.flatnonzero(2 * count >= count.max())
    return int(well_seen[np.argmin(np.abs(well_seen - middle))])


def fill_poses(poses: FloatArray, known: BoolArray) -> FloatArray:
    """Return poses (T, 4, 4) with the unknown ones on the screw between their known neighbors, held at both ends."""
    frames, out = np.flatnonzero(known), poses.copy()
    for frame in np.flatnonzero(~known).tolist():
        place = int(np.searchsorted(frames, frame))
        if place in (0, len(frames)):
            out[frame] = poses[frames[min(place, len(frames) - 1)]]
            continue
        first, last = frames[place - 1], frames[place]
        twist = se3.relative_twist(poses[first][None], poses[last][None])
        out[frame] = se3.retract(poses[first][None], twist * ((frame - first) / (last - first)))[0]
    return out


def moved_points(body: RigidBody, frame: IntArray, row: IntArray) -> FloatArray:
    """Return the world positions (N, 3) of points ``row`` (N,) in frames ``frame`` (N,)."""
    result: FloatArray = camera_to_world(body.world_T_object[frame], body.points[row])
    return result
