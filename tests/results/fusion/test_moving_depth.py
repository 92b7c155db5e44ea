"""What moves: its depth by trajectories, without the background that a cue mixes in, and from frames beside."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.results.fusion.bleeding import bleeding_radius, edge_profile
from uni4d_fg.results.fusion.moving_depth import carried_moving, correct_moving, without_bleeding

HEIGHT, WIDTH = 120, 160
NEAR, FAR = np.log(2.0), np.log(4.0)


def scene(blur_px: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of a thing, true log depth, and the same with depth averaged over squares of 2 blur_px + 1."""
    pixels = np.zeros((HEIGHT, WIDTH), bool)
    pixels[30:90, 50:110] = True
    truth = np.where(pixels, NEAR, FAR).astype(np.float32)
    return pixels, truth, np.log(cv2.blur(np.exp(truth), (2 * blur_px + 1,) * 2))


def test_trajectories_correct_an_instance_and_nothing_else(rng: np.random.Generator) -> None:
    pixels, truth, _ = scene()
    _, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    given = (truth + 0.1 + 0.05 * (u - 80) / 30).astype(np.float32)
    places = np.argwhere(pixels)[rng.choice(pixels.sum(), 150, replace=False)]
    uv, log_z = places[:, ::-1].astype(np.float64), truth[places[:, 0], places[:, 1]].astype(np.float64)
    log_z[:5] += 1.0
    corrected = correct_moving(given, pixels, uv, log_z, 0.0, FusionConfig())
    assert np.abs(corrected - truth)[pixels].mean() < 0.02
    np.testing.assert_array_equal(corrected[~pixels], given[~pixels])
    few = correct_moving(given, pixels, uv[:5], log_z[:5], 0.0, FusionConfig())
    np.testing.assert_array_equal(few, given)


def test_points_that_disagree_move_an_instance_less(rng: np.random.Generator) -> None:
    pixels, truth, _ = scene()
    places = np.argwhere(pixels)[rng.choice(pixels.sum(), 12, replace=False)]
    uv, right = places[:, ::-1].astype(np.float64), truth[places[:, 0], places[:, 1]].astype(np.float64)
    agreeing = correct_moving(truth, pixels, uv, right - 0.1, 0.0, FusionConfig())
    torn = correct_moving(truth, pixels, uv, right - np.linspace(0.0, 0.8, 12), 0.0, FusionConfig())
    assert np.abs(agreeing - truth)[pixels].mean() > 0.095
    assert np.abs(torn - truth)[pixels].mean() < 0.04


def test_what_a_cue_mixes_in_is_taken_out() -> None:
    pixels, truth, bled = scene(blur_px=8)
    before = np.abs(bled - truth)[pixels].mean()
    after = np.abs(without_bleeding(bled, pixels, 12.0) - truth)[pixels].mean()
    assert before > 0.06
    assert after < 0.25 * before
    np.testing.assert_array_equal(without_bleeding(bled, pixels, 0.0), bled)


@pytest.mark.parametrize("blur_px", [0, 4, 8])
def test_the_reach_of_bleeding_is_measured_through_a_smooth_error(blur_px: int) -> None:
    _, truth, bled = scene(blur_px)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    smooth = (0.08 * np.sin(u / 25) * np.cos(v / 20)).astype(np.float32)
    profile = edge_profile(bled + smooth, truth, np.ones(truth.shape, bool))
    assert profile is not None
    assert abs(bleeding_radius([profile, profile]) - blur_px) <= 1.5
    assert edge_profile(bled, np.full_like(truth, FAR), np.ones(truth.shape, bool)) is None
    assert np.isnan(bleeding_radius([]))


def test_a_frame_without_a_cue_takes_an_instance_from_the_frames_beside(rng: np.random.Generator) -> None:
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, 3 * WIDTH, 3)), (0, 0), 1.5)
    texture = np.clip((texture - 127) * 4 + 127, 0, 255).astype(np.uint8)
    _, u = np.mgrid[0:HEIGHT, 0:WIDTH]

    def frame(shift: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pixels = np.zeros((HEIGHT, WIDTH), bool)
        pixels[30:90, 50 + shift : 110 + shift] = True
        image = np.where(pixels[..., None], texture[:, 60 - shift : 60 - shift + WIDTH], texture[:, 200 : 200 + WIDTH])
        depth = np.where(pixels, NEAR + 0.004 * (u - shift - 80), FAR).astype(np.float32)
        return image, depth, pixels

    image, truth, pixels = frame(0)
    carried = carried_moving(pixels, image, [(*frame(-4), 1.0), (*frame(4), 1.0)])
    assert np.isnan(carried[~pixels]).all()
    assert np.abs(carried - truth)[pixels].mean() < 0.01
    assert np.isnan(carried_moving(pixels, image, [])).all()
