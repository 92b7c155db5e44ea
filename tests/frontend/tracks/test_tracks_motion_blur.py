"""Motion blur: how long it is found to be, what views need to be blurred alike, and tracks through a fast pan."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.arrays import FloatArray, ImageArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.tracks.first_views import FirstViews
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.frontend.tracks.motion_blur import MARGIN_PX, blurred, missing_blur, shift_of_all
from uni4d_fg.frontend.tracks.view_patches import ViewPatches
from uni4d_fg.pipeline.warnings import blur_warnings

HEIGHT, WIDTH = 160, 240
SUBSTEPS = 16
SHUTTER = 0.5
STEPS = np.array([0, 0, 1, 3, 8, 12, 14, 16, 16, 14, 10, 5, 2, 0, 0, 0], dtype=float)
"""How far a pan moves the image from frame to frame, px."""
AT = -np.concatenate(([0.0], np.cumsum(STEPS)))


def world() -> ImageArray:
    """A strip of smooth random texture, 4 samples a pixel."""
    rng = np.random.default_rng(2)
    size = (HEIGHT * 2, 2 * (WIDTH + 200))
    value = sum(
        weight * cv2.GaussianBlur(rng.normal(size=size).astype(np.float32), (0, 0), sigma) * sigma
        for sigma, weight in ((2.5, 1.0), (6.0, 1.0), (14.0, 1.0))
    )
    return np.clip(128 + 45 * np.asarray(value) / np.std(value), 0, 255).astype(np.uint8)


def seen_at(texture: ImageArray, shift: float) -> FloatArray:
    """The image of a camera to which the strip is shifted by so many px."""
    move = np.array([[1.0, 0.0, 2.0 * (shift + 160.0) - 320.0], [0.0, 1.0, 0.0]])
    moved = cv2.warpAffine(texture.astype(np.float32), move, (2 * WIDTH, 2 * HEIGHT), flags=cv2.INTER_LINEAR)
    return np.asarray(cv2.resize(moved, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), dtype=np.float64)


def pan(shutter: float = SHUTTER, still: tuple[int, int, int, int] | None = None) -> ImageArray:
    """Frames of a pan that are blurred while a shutter is open, with noise; a rectangle may stand still in them."""
    texture, noise = world(), np.random.default_rng(3)
    frames = np.arange(len(AT))
    images = []
    for t in frames:
        open_at = t + shutter * ((np.arange(SUBSTEPS) + 0.5) / SUBSTEPS - 0.5)
        image = np.mean([seen_at(texture, float(np.interp(s, frames, AT))) for s in open_at], axis=0)
        if still is not None:
            left, top, right, bottom = still
            image[top:bottom, left:right] = seen_at(texture[::-1], 0.0)[top:bottom, left:right]
        images.append(np.clip(image + noise.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8))
    return np.stack(images)


def following(match_blur: bool) -> TrackingConfig:
    return TrackingConfig(
        grid_columns=20, grid_rows=12, query_interval=100, margin_px=20, reseed_spacing=None, refine="on",
        match_blur=match_blur,
    )  # fmt: skip


def errors(images: ImageArray, match_blur: bool) -> FloatArray:
    """Errors of the tracks from the first frame along the pan, (K, T) px; NaN where not seen."""
    tracks = track_grid(ArrayFrames(images), following(match_blur))
    began = tracks.uv[tracks.query_frame == 0]
    return np.asarray(began[:, :, 0] - began[:, :1, 0] - AT, dtype=np.float64)


def test_tracks_through_a_fast_pan_keep_to_their_points() -> None:
    """Blur of up to 8 px: after it, points are where they were, and in it they err by less."""
    images = pan()
    matched, plain = errors(images, match_blur=True), errors(images, match_blur=False)
    after, within = slice(13, None), slice(5, 11)
    assert np.isfinite(matched[:, -1]).sum() >= 120

    def worst(error: FloatArray, frames: slice) -> float:
        return float(np.nanquantile(np.abs(error[:, frames]), 0.9))

    assert worst(matched, after) < 0.16
    assert worst(matched, after) < 0.35 * worst(plain, after)
    assert worst(matched, within) < 0.27
    assert worst(matched, within) < 0.65 * worst(plain, within)


def test_tracks_say_how_blurred_frames_are() -> None:
    found = track_grid(ArrayFrames(pan()), following(match_blur=True)).blur_px
    assert found is not None
    true = SHUTTER * 0.5 * (np.append(STEPS, 0.0) + np.append(0.0, STEPS))
    assert np.abs(found[:-1] - true[:-1])[true[:-1] >= 4].max() < 2.0
    assert not found[:2].any()
    assert not found[-1]
    said = blur_warnings(found, 6)
    assert len(said) == 1
    assert f"blurs {int((found > 6).sum())} frames by 6 px and more" in said[0]
    assert blur_warnings(found, 15) == []
    assert blur_warnings(None, 15) == []


def test_sharp_images_are_tracked_as_they_were() -> None:
    images = pan(shutter=0.0)
    np.testing.assert_array_equal(errors(images, match_blur=True), errors(images, match_blur=False))


def test_what_is_sharp_in_a_blurred_image_is_kept() -> None:
    """A thing that the camera follows is sharp while all else is blurred."""
    box = (60, 40, 170, 120)
    images = pan(still=box)
    tracks = track_grid(ArrayFrames(images), following(match_blur=True))
    uv = tracks.uv[tracks.query_frame == 0]
    left, top, right, bottom = box
    inside = (np.abs(uv[:, 0] - [(left + right) / 2, (top + bottom) / 2]) < [(right - left) / 2 - 12, 28]).all(axis=1)
    assert inside.sum() >= 20
    kept = np.isfinite(uv[inside, -1, 0])
    assert kept.mean() > 0.9
    assert np.median(np.linalg.norm(uv[inside][kept, -1] - uv[inside][kept, 0], axis=1)) < 0.1


def test_the_length_of_blur_is_found() -> None:
    images, config = pan(), following(match_blur=True)
    views = FirstViews(config)
    at = np.stack(np.meshgrid(np.arange(60, 200, 12), np.arange(20, 140, 12)), axis=-1).reshape(-1, 2)
    points = at.astype(np.float32)
    views.add(images[0], points)
    velocity = np.full_like(points, np.nan)
    found = []
    for t in range(1, len(images)):
        kept, moved = views.follow(images[t - 1], images[t], points, velocity)
        velocity, points = moved - points[kept], moved
        found.append(views.blur.copy())
    # Half of the mean of the steps to and from a frame.
    true = SHUTTER * 0.5 * (STEPS[:-1] + STEPS[1:])
    fast = true >= 4
    assert np.abs(np.array(found)[:-1][fast, 0] + true[fast]).max() < 2.0
    assert np.abs(np.array(found)[:-1][:, 1]).max() < 1.0
    assert not np.array(found)[:2].any()
    assert not found[-1].any()


def test_shift_of_all_is_that_of_most() -> None:
    texture = world()
    first, second = (seen_at(texture, shift).astype(np.uint8) for shift in (0.0, -12.0))
    np.testing.assert_allclose(shift_of_all(first, second), [-12.0, 0.0], atol=0.6)
    np.testing.assert_allclose(shift_of_all(first, first), [0.0, 0.0], atol=0.05)


@given(st.floats(-12, 12), st.floats(-12, 12))
def test_blur_keeps_brightness_and_place(x: float, y: float) -> None:
    """A point of light becomes a line about where it was, with the variance of even light along the vector."""
    image = np.zeros((41, 41), np.float32)
    image[20, 20] = 1.0
    smeared = blurred(image, np.array([x, y]))  # type: ignore[arg-type]
    v, u = np.mgrid[-20:21, -20:21]
    assert smeared.sum() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose([(smeared * u).sum(), (smeared * v).sum()], 0.0, atol=1e-4)
    spread = (smeared * (u * u + v * v)).sum()
    # Light between pixels is shared by four, which adds up to a quarter per direction.
    assert (x * x + y * y) / 12 - 0.05 <= spread <= (x * x + y * y) / 12 + 0.8


def test_missing_blur_adds_up_to_the_other() -> None:
    own, other = np.array([[0.0, 0.0], [6.0, 0.0], [0.0, 0.0], [12.0, 0.0]]), np.array([10.0, 0.0])
    missing = missing_blur(own, other[None])
    np.testing.assert_allclose(missing[:, 0], [10.0, 8.0, 10.0, 0.0])
    np.testing.assert_allclose(missing[:, 1], 0.0)
    assert not missing_blur(np.zeros((3, 2)), np.array([[1.0, 1.0]])).any()


def test_patches_are_blurred_as_images_are() -> None:
    """Cut and then blurred is what is cut of the blurred image, with nothing of neighbors in the stack."""
    image = seen_at(world(), 0.0).astype(np.uint8)
    points = np.array([[60.3, 50.8], [120.0, 80.5], [100.9, 90.1], [3.0, 80.0]], np.float32)
    vector = np.array([2 * MARGIN_PX - 1.0, 6.0])
    vector *= (2 * MARGIN_PX - 1.0) / np.linalg.norm(vector)
    some = np.array([2, 0, 1, 3])
    found = ViewPatches.cut(image, points, 15, np.zeros(2)).blurred(some, vector)
    expected = ViewPatches.cut(blurred(image, vector), points[some], 15, vector).template
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    assert np.isnan(found[3]).any()
    inside = np.isfinite(found)
    inside[3] = False  # beyond the image's edge its blur is a guess
    assert np.abs(found - expected)[inside].max() < 1.0
