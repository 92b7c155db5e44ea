from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.arrays import BoolArray, FloatArray, ImageArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.synthetic.simulate import simulate
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.interruption import is_interrupted
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera

HEIGHT, WIDTH, FRAMES = 120, 200, 60
SPEED = np.array([0.4, -0.2])
"""Of the background, px per frame."""
BLOCK_PX, BLOCK_SPEED = 60, 4
"""A block that hides every point for 15 frames."""
CONFIG = TrackingConfig(grid_columns=20, grid_rows=12, query_interval=FRAMES, margin_px=10, reseed_spacing=None)


def texture(seed: int, height: int, width: int) -> FloatArray:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 5 * (smooth - smooth.mean()), 0, 255)


def block(t: int) -> tuple[int, int]:
    """The columns that are hidden: it enters from the left after ten frames."""
    right = BLOCK_SPEED * (t - 10)
    return max(right - BLOCK_PX, 0), max(min(right, WIDTH), 0)


def video(behind: int | None = None) -> ImageArray:
    """A background that shifts, and the block; ``behind`` is the seed of another background behind the block."""
    images = np.empty((FRAMES, HEIGHT, WIDTH), np.uint8)
    planes = [texture(seed, HEIGHT + 40, WIDTH + 40) for seed in (0, 0 if behind is None else behind)]
    front = texture(2, HEIGHT, WIDTH)
    for t in range(FRAMES):
        left, right = block(t)
        shift = np.array([[1, 0, SPEED[0] * t - 20], [0, 1, SPEED[1] * t - 20]])
        for plane, columns in zip(planes, (slice(right, WIDTH), slice(0, left)), strict=True):
            images[t, :, columns] = np.rint(cv2.warpAffine(plane, shift, (WIDTH, HEIGHT)))[:, columns]
        images[t, :, left:right] = front[:, : right - left]
    return images


def track(images: ImageArray, bridge_frames: int | None, query_interval: int = FRAMES) -> Tracks:
    config = CONFIG.model_copy(update={"bridge_frames": bridge_frames, "query_interval": query_interval})
    return track_grid(ArrayFrames(images), config)


def seen_again(tracks: Tracks) -> tuple[FloatArray, BoolArray]:
    """Return the true places (K, T, 2) px of tracks that start in frame 0, and (K, T) where the block has passed."""
    truth = tracks.uv[:, :1] + SPEED * np.arange(FRAMES)[:, None]
    passed = np.stack([truth[:, t, 0] < block(t)[0] for t in range(FRAMES)], axis=1)
    inside = ((truth >= 8) & (truth <= [WIDTH - 9, HEIGHT - 9])).all(axis=2)
    return truth, passed & inside


@pytest.mark.parametrize("passes", [True, False])
def test_where_something_sweeps_over_the_picture_it_is_bridged_without_being_asked_for(passes: bool) -> None:
    """A block as wide as most of the picture, which nothing outlives; and the same video before it comes."""
    wide, planes = 170, texture(0, HEIGHT + 40, WIDTH + 40)
    images = np.empty((50, HEIGHT, WIDTH), np.uint8)
    for t in range(len(images)):
        shift = np.array([[1, 0, SPEED[0] * t - 20], [0, 1, SPEED[1] * t - 20]])
        images[t] = np.rint(cv2.warpAffine(planes, shift, (WIDTH, HEIGHT)))
        end = 20 * (t - 10)
        left, right = min(max(end - wide, 0), WIDTH), max(min(end, WIDTH), 0)
        if passes and left < right:
            images[t, :, left:right] = texture(2, HEIGHT, WIDTH)[:, : right - left]
    lost, bridged, found = (track(images, frames, query_interval=10) for frames in (0, 25, None))
    assert is_interrupted(lost.visible) is passes
    expected = bridged if passes else lost
    np.testing.assert_array_equal(found.visible, expected.visible)
    np.testing.assert_array_equal(found.uv, expected.uv)
    outlive = [np.count_nonzero(tracks.visible[:, 8] & tracks.visible[:, 45]) for tracks in (lost, found)]
    if passes:
        assert outlive[1] > 100 + 2 * outlive[0]


def test_tracks_that_are_short_throughout_are_not_interrupted(rng: np.random.Generator) -> None:
    first = rng.integers(-11, 60, 4000)[:, None]
    short = (np.arange(60) >= first) & (np.arange(60) < first + 12)
    assert not is_interrupted(short)
    cut = short & ~((first < 30) & (np.arange(60) >= 30))  # all end at once
    assert is_interrupted(cut)
    assert not is_interrupted(cut[:, 20:40])  # too short to tell


@pytest.mark.parametrize("refine", ["off", "on"])
def test_most_points_are_found_behind_what_hid_them(refine: str) -> None:
    config = CONFIG.model_copy(update={"refine": refine, "bridge_frames": 25})
    tracks = track_grid(ArrayFrames(video()), config)
    truth, passed = seen_again(tracks)
    # In sight for as long as two searches are apart, and for what the patch needs to be free.
    due = passed[:, -10]
    joined = (tracks.visible & passed).any(axis=1)
    assert due.sum() > 80
    assert joined[due].mean() > 0.7
    error = np.linalg.norm(tracks.uv - truth, axis=2)[tracks.visible & passed]
    assert (error < 1.0).mean() > 0.99
    assert np.isnan(tracks.uv[~tracks.visible]).all()


def test_what_is_lost_stays_lost_without() -> None:
    tracks = track(video(), 0)
    _, passed = seen_again(tracks)
    assert not (tracks.visible & passed).any()


def test_an_occlusion_that_lasts_too_long_is_not_bridged() -> None:
    tracks = track(video(), 8)
    _, passed = seen_again(tracks)
    assert not (tracks.visible & passed).any()


def test_another_background_is_not_taken_for_the_one_before() -> None:
    tracks = track(video(behind=5), 25)
    _, passed = seen_again(tracks)
    assert (tracks.visible & passed).any(axis=1).sum() <= 1


def test_recall_and_precision_in_a_room_with_parallax() -> None:
    """A textured disc passes before a hand-held camera and hides what stands still for 15 frames."""
    frames, height, width, radius = 45, 180, 240, 36.0
    simulation = simulate(
        SyntheticSceneConfig(
            num_frames=frames, height=height, width=width, focal=225.0, objects="none", grid_columns=2, grid_rows=2
        )
    )
    scene, images = simulation.sequence, np.stack(list(simulation.sequence.images))
    poses, intrinsics, depths = (
        scene.ground_truth.world_T_cam, scene.ground_truth.intrinsics, scene.ground_truth.depths,
    )  # fmt: skip
    assert poses is not None
    assert intrinsics is not None
    assert depths is not None
    y, x = np.mgrid[:height, :width]
    middle = np.array([width, height]) / 2 + 2 * radius / 15 * np.arange(-22, 23)[:, None] * np.array([0.8, 0.6])
    covered = (x - middle[:, 0, None, None]) ** 2 + (y - middle[:, 1, None, None]) ** 2 < radius**2
    front = texture(3, height, width).astype(np.uint8)
    for t in range(frames):
        images[t][covered[t]] = np.roll(front, (2 * t, 3 * t), (0, 1))[covered[t]][:, None]

    tracks = track_grid(
        ArrayFrames(images), TrackingConfig(grid_columns=40, grid_rows=30, query_interval=frames, bridge_frames=25)
    )
    start = tracks.uv[tracks.query_frame == 0, 0].astype(float)
    column, line = np.rint(start).astype(int).T
    points = unproject(intrinsics, start, np.asarray(depths[0], float)[line, column])
    points = camera_to_world(np.broadcast_to(poses[0], (len(start), 4, 4)), points)
    truth = np.stack(
        [project(intrinsics, world_to_camera(np.broadcast_to(p, (len(start), 4, 4)), points)) for p in poses], axis=1
    )
    visible = tracks.visible[tracks.query_frame == 0]
    error = np.linalg.norm(tracks.uv[tracks.query_frame == 0] - truth, axis=2)
    pixel = np.rint(np.clip(truth, 0, [width - 1, height - 1])).astype(int)
    hidden = covered[np.arange(frames), pixel[..., 1], pixel[..., 0]]
    possible = joined = right = 0
    for k in range(len(start)):
        begin, end = int(hidden[k].argmax()), int(frames - hidden[k, ::-1].argmax())
        inside = ((truth[k, end:] >= 8) & (truth[k, end:] <= [width - 9, height - 9])).all()
        if begin < 6 or not visible[k, begin - 4] or error[k, begin - 4] > 1 or end > frames - 10 or not inside:
            continue
        found = np.flatnonzero(visible[k, end:])
        possible += 1
        joined += len(found) > 0
        right += len(found) > 0 and bool(error[k, end + found[0]] < error[k, begin - 4] + 2)
    assert possible > 60
    assert joined > 0.75 * possible
    assert joined - right <= 1


def test_where_all_is_lost_at_once_points_go_on_as_without_bridging() -> None:
    """Black, a scene, and another one: a frame that shows nothing is remembered beside those whose points are lost."""
    scenes = [np.rint(texture(seed, HEIGHT, WIDTH)) for seed in (0, 7)]
    images = np.zeros((36, HEIGHT, WIDTH), np.uint8)
    images[6:16], images[16:] = scenes
    plain, bridged = (track(images, frames, query_interval=4) for frames in (0, 25))
    for tracks in (plain, bridged):
        first, second = tracks.visible[:, 6:16].any(axis=1), tracks.visible[:, 16:].any(axis=1)
        assert (first & ~second).sum() > 100
        assert (second & ~first).sum() > 100
        assert not tracks.visible[:, :5].any()
    np.testing.assert_array_equal(bridged.visible.sum(axis=0), plain.visible.sum(axis=0))
