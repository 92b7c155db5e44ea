"""What moves along with the camera is told by the ground that it would be seen through."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from uni4d_fg.arrays import BoolArray
from uni4d_fg.config.load import load_config
from uni4d_fg.cues.geometric_depth import GeometricDepth, depth_from_motion
from uni4d_fg.cues.structure.triangulation import RayBundle, inverse_depths_along
from uni4d_fg.frontend.sequence.model import ArrayFrames, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.geometry.se3 import so3_exp

FRAMES, SIZE = 24, (240, 320)
INTRINSICS = np.array([300.0, 300.0, 159.5, 119.5])
HEIGHT, AHEAD = 1.3, 9.0
"""Of the camera above the road, and how far the car ahead is, m."""


@dataclass(frozen=True)
class Road:
    """Tracks that a camera on a road sees."""

    tracks: Tracks
    world_T_cam: np.ndarray
    on_car: BoolArray
    low: BoolArray
    """Those of the car's lower half, behind which the road is at most twice as far."""
    under: BoolArray
    """Those of what is really deeper than the road."""

    @property
    def video(self) -> Video:
        images = ArrayFrames(np.zeros((FRAMES, *SIZE, 3), np.uint8))
        return Video("road", images, SIZE, np.arange(FRAMES, dtype=np.float64))


@cache
def road(with_car: bool = True, with_canal: bool = False, seed: int = 0) -> Road:
    """A camera that goes 0.4 m per frame along z, behind a car that moves as it does, or along a canal; y is down."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = so3_exp(np.stack([0.01 * rng.normal(size=FRAMES) for _ in range(3)], axis=1))
    poses[:, 2, 3] = 0.4 * np.arange(FRAMES)
    poses[:, 0, 3] = 0.3 * np.sin(0.3 * np.arange(FRAMES))
    depth = np.exp(rng.uniform(np.log(3.0), np.log(50.0), 2500))
    ground = np.stack([depth * rng.uniform(-0.5, 0.5, 2500), np.full(2500, HEIGHT), depth], axis=1)
    side = np.where(rng.random(1200) < 0.5, -1.0, 1.0)
    beside = np.stack([side * rng.uniform(6, 9, 1200), rng.uniform(-4, HEIGHT, 1200), rng.uniform(5, 70, 1200)], axis=1)
    canal = np.zeros((0, 3))
    if with_canal:
        in_canal = np.abs(ground[:, 0] - 0.12 * ground[:, 2]) < 0.08 * ground[:, 2]
        canal, ground = ground[in_canal] * [1, 4, 1], ground[~in_canal]
    still = np.concatenate([ground, beside, canal])
    car = rng.uniform([-0.9, -0.1, AHEAD], [0.9, HEIGHT, AHEAD + 0.1], (150 if with_car else 0, 3))
    count = len(still) + len(car)
    uv, visible = np.full((count, FRAMES, 2), np.nan, np.float32), np.zeros((count, FRAMES), bool)
    corners = np.array([[-0.95, -0.15, AHEAD], [0.95, HEIGHT, AHEAD]])
    for frame, pose in enumerate(poses):
        moved = pose[:3, 3]
        x = world_to_camera(pose, np.concatenate([still, car + moved]))
        seen = x[:, 2] > 1.0
        at = project(INTRINSICS, np.where(seen[:, None], x, 1.0)) + rng.normal(0, 0.15, (count, 2))
        seen &= (at >= 0).all(axis=1) & (at <= [SIZE[1] - 1, SIZE[0] - 1]).all(axis=1)
        if with_car:
            low, high = np.sort(project(INTRINSICS, world_to_camera(pose, corners + moved)), axis=0)
            hidden = ((at > low) & (at < high)).all(axis=1) & (x[:, 2] > AHEAD)
            seen &= ~hidden | (np.arange(count) >= len(still))
        uv[seen, frame], visible[:, frame] = at[seen], seen
    tracks = Tracks(uv, visible, np.argmax(visible, axis=1).astype(np.int32))
    index = np.arange(count)
    low = index >= len(still)
    low[low] = car[:, 1] > HEIGHT / 2
    under = (index >= len(still) - len(canal)) & (index < len(still))
    return Road(tracks, poses, index >= len(still), low, under)


def depth_of(scene: Road) -> GeometricDepth:
    everything = np.ones(scene.tracks.num_tracks, dtype=bool)
    return depth_from_motion(scene.video, scene.tracks, everything, INTRINSICS, load_config("default"))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_car_that_is_as_fast_as_the_camera_moves(seed: int) -> None:
    scene = road(seed=seed)
    found = depth_of(scene)
    often = np.count_nonzero(scene.tracks.visible, axis=1) >= 5
    # What is near the horizon has no ground behind it that is known.
    assert found.moving[scene.low].mean() > 0.9
    assert found.moving[scene.on_car].mean() > 0.4
    assert found.moving[~scene.on_car & often].mean() < 0.01
    assert not np.isfinite(found.sparse[found.moving]).any()


def test_what_is_seen_in_a_canal_stands_still() -> None:
    scene = road(with_car=False, with_canal=True)
    found = depth_of(scene)
    assert np.count_nonzero(scene.under) > 150
    assert found.moving[scene.under].mean() < 0.02
    assert found.moving.mean() < 0.01


def test_inverse_depths_are_found_up_to_infinity() -> None:
    rng = np.random.default_rng(0)
    scene = road()
    frames, tracks = np.arange(FRAMES), 400
    inverse = np.concatenate([np.zeros(tracks // 2), 1.0 / rng.uniform(12.0, 60.0, tracks // 2)])
    direction = np.stack([rng.uniform(-0.3, 0.3, tracks), rng.uniform(-0.3, 0.3, tracks), np.ones(tracks)], axis=1)
    reference = scene.world_T_cam[0]
    uv = []
    for pose in scene.world_T_cam:
        relative = np.linalg.inv(pose) @ reference
        uv.append(project(INTRINSICS, direction @ relative[:3, :3].T + inverse[:, None] * relative[:3, 3]))
    exact = np.stack(uv, axis=1)
    for sigma in (0.0, 0.3):
        seen = exact + sigma * rng.normal(size=exact.shape)
        rays = RayBundle(
            np.repeat(np.arange(tracks), FRAMES), scene.world_T_cam, np.tile(frames, tracks), seen.reshape(-1, 2),
            INTRINSICS, tracks,
        )  # fmt: skip
        found, told = inverse_depths_along(rays, FRAMES * np.arange(tracks), max(sigma, 1e-3))
        if sigma == 0.0:
            np.testing.assert_allclose(found, inverse, atol=1e-9)
        else:
            # One standard deviation is exceeded by a third of them, three by few.
            assert 0.1 < np.mean(np.abs(found - inverse) > told) < 0.45
            assert np.mean(np.abs(found - inverse) > 3 * told) < 0.03
