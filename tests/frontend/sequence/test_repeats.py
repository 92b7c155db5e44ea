"""Frames that repeat the one before: found at coding noise, and not in a camera at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_bars import SIZE, pan
from video_samples import write_video

from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.repeats import repeated_frames
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid

CONFIG = TrackingConfig(grid_columns=12, grid_rows=9)


def found_in(frames: np.ndarray, path: Path | None = None) -> list[int]:
    images = ArrayFrames(frames) if path is None else open_video(write_video(path, list(frames))).images
    return np.flatnonzero(repeated_frames(images, track_grid(images, CONFIG))).tolist()


@pytest.mark.parametrize("encoded", [False, True])
@pytest.mark.parametrize(
    ("shown", "repeats"),
    [
        ([0, 1, 2, 2, 3, 4, 5, 5, 6, 7, 8, 9], [3, 7]),  # frames dropped by the recorder
        ([0, 0, 1, 2, 3, 3, 4, 5, 6, 6, 7, 8], [1, 5, 9]),  # 3 in 4
        ([0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3], [1, 2, 4, 5, 7, 8, 10, 11]),  # film at three times its rate
    ],
)
def test_repeats_are_found(tmp_path: Path, encoded: bool, shown: list[int], repeats: list[int]) -> None:
    frames = pan()[shown]
    noisy = np.clip(pan().astype(np.int16) + np.random.default_rng(1).normal(0, 3, pan().shape), 0, 255)
    assert found_in(frames, tmp_path / "a.mp4" if encoded else None) == repeats
    assert found_in(noisy.astype(np.uint8)[shown]) == repeats  # the noise is repeated too


def test_a_camera_at_rest_repeats_nothing() -> None:
    rng = np.random.default_rng(2)
    where = [0, 1, 2, 3, 3, 3, 3, 4, 5, 6, 7, 7, 8, 9]  # stops and goes, with the noise of the sensor
    stop_and_go = np.clip(pan()[where] + rng.normal(0, 3, (len(where), *SIZE, 3)), 0, 255).astype(np.uint8)
    assert found_in(stop_and_go) == []
    at_rest = np.repeat(pan(1), 12, axis=0)
    assert found_in(at_rest) == []
    moving_thing = pan()[[0, 1, 2, 3, 4, 4, 5, 6, 7, 8]]
    moving_thing[5, 50:70, 60:80] = moving_thing[5, 50:70, 64:84]
    assert found_in(moving_thing) == []
    assert found_in(pan()) == []


def test_pictures_without_texture_say_nothing() -> None:
    where = np.cumsum([0, 3, 3, 3, 0, 3, 3, 3, 3, 3])[None, :, None] + np.array([20.0, 30.0, 40.0])[:, None, None]
    tracks = Tracks(np.repeat(where, 2, axis=2).astype(np.float32), np.ones((3, 10), bool), np.zeros(3, np.int32))
    flat = ArrayFrames(np.full((10, *SIZE, 3), 128, np.uint8))
    assert not repeated_frames(flat, tracks).any()
