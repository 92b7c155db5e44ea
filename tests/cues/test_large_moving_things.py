"""Things that hold most of the tracks, as somebody who films themselves: known to move, they bend nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from cues.start_scenes import GUESS, SIZE, K, TrackedScene, sideways, tracked

from uni4d_fg.config.load import load_config
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.outlier_tracks import find_outlier_tracks
from uni4d_fg.cues.structure.motion import structure_from_motion
from uni4d_fg.cues.structure.triangulation import RayBundle, directions_far_away
from uni4d_fg.cues.track_motion import find_moving_tracks
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, unproject, world_to_camera
from uni4d_fg.progress import SilentReporter
from uni4d_fg.slam.stages.scene import Cameras

CONFIG = load_config("default", [])
FRAMES, ROOM, BODY = 12, 200, 300


def selfie(rng: np.random.Generator, going: float = 0.02) -> tuple[LabelledTracks, np.ndarray, np.ndarray]:
    """Tracks of a room and of somebody who goes along with the camera, with three fifths of the tracks; poses."""
    poses = np.stack([se3.se3_exp(t * np.array([0.002, 0.004, 0.0, going, 0.0, -going])) for t in range(FRAMES)])
    room = unproject(K, rng.uniform((5, 5), (315, 235), (ROOM, 2)), rng.uniform(2.0, 6.0, ROOM))
    body = unproject(K, rng.uniform((90, 80), (230, 230), (BODY, 2)), rng.uniform(0.7, 0.9, BODY))
    sway = np.stack([0.02 * np.sin(0.9 * np.arange(FRAMES) + phase) for phase in (0.0, 1.0, 2.0)], axis=1)
    in_camera = np.concatenate(
        [
            np.stack([world_to_camera(pose, room) for pose in poses], axis=1),
            body[:, None] + sway,
        ]
    )
    uv = project(K, in_camera) + rng.normal(0, 0.2, (ROOM + BODY, FRAMES, 2))
    seen = (uv > 0).all(axis=2) & (uv < (SIZE[1] - 1, SIZE[0] - 1)).all(axis=2) & (in_camera[..., 2] > 0.3)
    depth = in_camera[..., 2] * np.exp(rng.normal(0, 0.02, seen.shape))
    zero = np.zeros(len(uv), np.int32)
    tracks = Tracks(np.where(seen[..., None], uv, np.nan).astype(np.float32), seen, zero)
    labelled = LabelledTracks(tracks, zero, zero, seen.astype(np.float32), depth.astype(np.float32))
    return labelled, np.arange(len(uv)) >= ROOM, poses


def test_of_what_is_known_to_move_no_majority_is_made(rng: np.random.Generator) -> None:
    labelled, moves, _ = selfie(rng, going=0.06)
    config = MotionMaskConfig()
    first = find_outlier_tracks(labelled, K, config, np.zeros(len(moves), bool))
    assert first[~moves].mean() > 0.5  # the room disagrees with the majority
    known = find_outlier_tracks(labelled, K, config, moves)
    assert known[~moves].mean() < 0.05
    assert not known[moves].any()  # those take no part


def test_what_all_tracks_share_is_not_fitted_to_what_is_known_to_move(rng: np.random.Generator) -> None:
    labelled, moves, poses = selfie(rng)
    spread = np.zeros(labelled.depth.shape, np.float32)
    cameras, config = Cameras(poses, K, np.zeros(FRAMES)), MotionMaskConfig()
    bent, told = (
        find_moving_tracks(labelled, spread, cameras, SIZE, config, known)
        for known in (np.zeros(len(moves), bool), moves)
    )
    assert bent.static[~moves].mean() < 0.7
    assert told.static[~moves].mean() > 0.95
    assert told.moving[moves].mean() > 0.9


@pytest.mark.parametrize("seed", [0, 1])
def test_rays_that_part_belong_to_what_moves(seed: int) -> None:
    """Somebody overtaken by the background: their rays meet behind the cameras, and nowhere."""
    poses = sideways(20)
    scene = tracked(poses, seed, points=1500, moving=150, size=0.5)
    scene = overtaking(scene)
    found = structure_from_motion(
        scene.observations, len(poses), SIZE, GUESS, CONFIG, SilentReporter(), lambda: False, with_doubts=False
    )
    assert found is not None
    moves = scene.moves[found.track]
    assert np.isnan(found.points.error_px[moves]).mean() > 0.3  # without a point in front of the cameras
    assert found.moving[moves].mean() > 0.9
    assert found.moving[~moves].mean() < 0.03


def overtaking(scene: TrackedScene) -> TrackedScene:
    """The thing runs ahead of the camera, which moves to the right: in the picture as well it goes to the right."""
    seen = scene.observations
    ahead = np.where(scene.moves[seen.track], 4.0 * seen.frame, 0.0)
    uv = seen.uv + np.stack([ahead, np.zeros(len(ahead))], axis=1)
    inside = uv[:, 0] < SIZE[1]
    moved = dataclasses.replace(seen, uv=uv).select(inside).with_min_observations(2)
    return dataclasses.replace(scene, observations=moved)


def test_points_far_away_are_seen_in_the_mean_direction_whatever_the_camera_does() -> None:
    poses = sideways(5)
    direction = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.0]])
    far = 1e6 * direction
    uv = np.concatenate([project(K, world_to_camera(pose, far)) for pose in poses])
    rays = RayBundle(np.tile([0, 1], 5), poses, np.repeat(np.arange(5), 2), uv, K, 3)
    points = directions_far_away(rays)
    again = np.concatenate([project(K, world_to_camera(pose, points[:2])) for pose in poses])
    np.testing.assert_allclose(again, uv, atol=1e-2)
    assert np.isnan(points[2]).all()  # no ray, no direction
    nothing = RayBundle(np.zeros(0, int), poses, np.zeros(0, int), np.zeros((0, 2)), K, 2)
    assert np.isnan(directions_far_away(nothing)).all()
