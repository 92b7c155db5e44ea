r"""Near and far exchanged: where a camera turns much and moves little, tracks nearly allow that, the path mirrored.

What a rotation leaves over of the motion of a point with inverse depth q, seen from a camera at c, is about -q c across
its ray. Of that the rotation takes up what the points have in common, m c with their usual inverse depth m, and the
rest, -(q - m) c, is the same for

    c' = -c,    q' = 2 m - q.

Perspective tells the two apart, but bundle adjustment does not get from one to the other, and which of them a scene
begins with is chance where its first cameras see little parallax. So the other one is made of what was found, refined,
and judged by the same tracks.
Source: Szeliski and Kang 1997, "Shape ambiguities in structure from motion" (the Necker reversal and its stability).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.judging import robust_energy
from uni4d_fg.cues.structure.trimming import trim_and_converge
from uni4d_fg.errors import SolverError

_NEARLY = 20.0
"""The reversed scene is refined if it misses the tracks by no more than so many times what the scene itself does."""
_HOPELESS = 1.35
"""Times the robust energy of a scene from which on the reversed one is given up before it is trimmed: in eleven
scenes trimming took away a fifth at most, and the only one that was taken in the end had 1.07."""
_FARTHEST = 20.0
"""Of the usual distance: what a reversal takes beyond infinity is put there."""
_LEAST_POINTS = 6


def nearer_to_the_tracks(scene: GrowingScene) -> GrowingScene:
    """Return a grown scene, or the one with near and far exchanged where that explains the tracks better.

    Args:
        scene: Refined.

    Raises:
        Cancelled: If asked to stop.
    """
    other = exchanged_and_refined(scene, _HOPELESS)
    if other is None:
        return scene
    return other if robust_energy(other, scene.noise_px) < robust_energy(scene, scene.noise_px) else scene


def exchanged_and_refined(scene: GrowingScene, hopeless: float = math.inf) -> GrowingScene | None:
    """Return a scene with near and far exchanged, refined; None where it misses the tracks by far.

    Args:
        scene: Refined.
        hopeless: Times the robust energy of the scene that the other one has at most before it is trimmed.

    Raises:
        Cancelled: If asked to stop.
    """
    other = exchanged(scene)
    if other is None:
        return None
    known = scene.good & np.isfinite(scene.position[scene.row, 0])
    missed, before = (float(np.median(one.errors()[known])) for one in (other, scene))
    if not missed <= _NEARLY * before:
        return None
    try:
        _adjust(other)
        if robust_energy(other, scene.noise_px) > hopeless * robust_energy(scene, scene.noise_px):
            return None
        trim_and_converge(other)
    except SolverError:
        return None
    return other


def _adjust(scene: GrowingScene) -> None:
    """Refine a scene whose points and cameras have just been moved, at first with the focal lengths held."""
    free, scene.free_focal = scene.free_focal, False
    scene.triangulate_all()
    scene.adjust()
    scene.free_focal = free
    scene.triangulate_all()
    scene.adjust()


def exchanged(scene: GrowingScene) -> GrowingScene | None:
    """Return a scene with near and far exchanged about the middle of the path, not refined; None without points.

    Cameras turn so that what they see lies in the directions of the new points.
    """
    settings = scene.config.geometric_depth
    frames = np.flatnonzero(scene.registered)
    center = scene.world_T_cam[frames, :3, 3].mean(axis=0)
    ray = scene.position - center
    distance = np.linalg.norm(ray, axis=1)
    known = np.isfinite(distance) & ~scene.left_out
    if known.sum() < _LEAST_POINTS:
        return None
    usual = float(np.median(1.0 / distance[known]))
    inverse = np.maximum(2.0 * usual - 1.0 / distance, usual / _FARTHEST)
    position = center + ray / (distance * inverse)[:, None]
    poses = scene.world_T_cam.copy()
    poses[frames, :3, 3] = 2.0 * center - poses[frames, :3, 3]
    seen, uv = scene.good & np.isfinite(position[scene.row, 0]), scene.observations.uv
    plane = (uv - scene.intrinsics[2:]) / scene.intrinsics[:2]
    bearing = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    for frame in frames:
        mine = np.flatnonzero(seen & (scene.observations.frame == frame))
        if len(mine) < _LEAST_POINTS:
            continue
        direction = position[scene.row[mine]] - poses[frame, :3, 3]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        poses[frame, :3, :3] = Rotation.align_vectors(direction, bearing[mine])[0].as_matrix()
    return replace(
        scene, world_T_cam=poses, position=position, good=scene.good.copy(), registered=scene.registered.copy(),
        intrinsics=scene.intrinsics.copy(), left_out=np.zeros_like(scene.left_out),
        limit_px=np.full_like(scene.limit_px, settings.max_reprojection_px),
    )  # fmt: skip
