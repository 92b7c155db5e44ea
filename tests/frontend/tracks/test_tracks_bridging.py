from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.arrays import BoolArray, FloatArray, ImageArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid

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


def track(images: ImageArray, bridge_frames: int) -> Tracks:
    config = CONFIG.model_copy(update={"bridge_frames": bridge_frames})
    return track_grid(ArrayFrames(images), config)


def seen_again(tracks: Tracks) -> tuple[FloatArray, BoolArray]:
    """Return the true places (K, T, 2) px of tracks that start in frame 0, and (K, T) where the block has passed."""
    truth = tracks.uv[:, :1] + SPEED * np.arange(FRAMES)[:, None]
    passed = np.stack([truth[:, t, 0] < block(t)[0] for t in range(FRAMES)], axis=1)
    inside = ((truth >= 8) & (truth <= [WIDTH - 9, HEIGHT - 9])).all(axis=2)
    return truth, passed & inside


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
    tracks = track_grid(ArrayFrames(video()), CONFIG)
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
