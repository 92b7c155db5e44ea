"""Tracks that go over from one static surface to another, seen by known cameras."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.cues.structure.one_surface import strays
from uni4d_fg.cues.structure.triangulation import RayBundle, triangulate
from uni4d_fg.geometry.camera import project, world_to_camera

K = np.array([500.0, 500.0, 320.0, 180.0])
FRAMES = 40
LIMIT_PX, HUBER_PX = 1.5, 1.0


def cameras(rng: np.random.Generator) -> np.ndarray:
    """A camera that goes sideways, in a hand that trembles."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.4, 0.4, FRAMES)
    poses[:, :3, 3] += rng.normal(0, 0.01, (FRAMES, 3)).cumsum(axis=0)
    return poses


def rays_of(paths: list[np.ndarray], poses: np.ndarray, rng: np.random.Generator) -> RayBundle:
    """Rays to points (T, 3) each, with noise; track by track, in the order of time."""
    uv = [project(K, world_to_camera(poses, path)) + rng.normal(0, 0.2, (FRAMES, 2)) for path in paths]
    row, frame = np.repeat(np.arange(len(paths)), FRAMES), np.tile(np.arange(FRAMES), len(paths))
    return RayBundle(row, poses, frame, np.concatenate(uv), K, len(paths))


def found_strays(rays: RayBundle) -> np.ndarray:
    return strays(rays, triangulate(rays, HUBER_PX).errors_of(rays), LIMIT_PX, HUBER_PX)


def standing(x: float, z: float) -> np.ndarray:
    return np.tile([x, 0.1, z], (FRAMES, 1))


def going_over(where: float, at: int, poses: np.ndarray) -> np.ndarray:
    """A point of a wall, and from a frame on the one of a pole before it that then hides it."""
    path = standing(where, 6.0)
    center = poses[at, :3, 3]
    path[at:] = center + (path[at] - center) * (2.0 - center[2]) / (6.0 - center[2])
    return path


@pytest.mark.parametrize("backwards", [False, True])
def test_the_longer_part_is_kept(backwards: bool, rng: np.random.Generator) -> None:
    poses = cameras(rng)
    paths = [going_over(x, 26, poses) for x in np.linspace(-1.0, 1.0, 8)]
    if backwards:
        paths, poses = [path[::-1] for path in paths], poses[::-1]
    found = found_strays(rays_of(paths, poses, rng))
    of_pole = np.arange(FRAMES) >= 26
    share = found.reshape(8, FRAMES).mean(axis=0)
    truth = of_pole[::-1] if backwards else of_pole
    # Where the surfaces coincide, a ray is of both.
    assert (share[truth] > 0.9).mean() > 0.8
    assert (share[~truth] == 0).all()


def test_what_is_of_one_surface_is_left_whole(rng: np.random.Generator) -> None:
    poses = cameras(rng)
    whole = [standing(x, z) for x, z in zip(np.linspace(-1, 1, 10), np.linspace(1.5, 9, 10), strict=True)]
    assert not found_strays(rays_of(whole, poses, rng)).any()


def test_what_begins_to_move_is_left_whole(rng: np.random.Generator) -> None:
    """It stands for half of the time, and then walks and swings: no other point explains the rest."""
    poses = cameras(rng)
    since = np.maximum(np.arange(FRAMES) - 18, 0)
    paths = []
    for x in np.linspace(-1, 1, 6):
        path = standing(x, 4.0)
        path[:, 0] += 0.03 * since
        path[:, 1] += 0.1 * np.sin(0.6 * since)
        paths.append(path)
    assert not found_strays(rays_of(paths, poses, rng)).any()


def test_short_tracks_and_none_are_left_alone(rng: np.random.Generator) -> None:
    poses = cameras(rng)
    rays = rays_of([going_over(0.3, 26, poses)], poses, rng)
    short = rays.select((rays.frame > 20) & (rays.frame < 31))
    assert not found_strays(short).any()
    assert len(found_strays(rays.select(rays.frame < 0))) == 0
