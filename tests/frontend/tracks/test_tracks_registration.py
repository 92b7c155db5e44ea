from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.frontend.tracks.lucas_kanade import track_grid
from uni4d_fg.frontend.tracks.registration import cut_templates, is_fast, register
from uni4d_fg.slam.incremental.tracking import OnlineTracker

HEIGHT, WIDTH = 120, 160
CENTER = np.array([80.0, 60.0])
FRAMES = 41
IDENTITY = np.array([1.0, 0.0, 0.0, 1.0])


def textured(map_back: FloatArray, shift: FloatArray, gain: float = 1.0, lift: float = 0.0) -> ImageArray:
    """A smooth random texture, exact anywhere: the pixel p shows it at ``map_back (p - c) + c + shift``."""
    rng = np.random.default_rng(5)
    waves = rng.uniform(0.12, 0.6, 30) * np.exp(1j * rng.uniform(0, 2 * np.pi, 30))
    phase = rng.uniform(0, 2 * np.pi, 30)
    pixel = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).astype(float)
    at = (pixel - CENTER) @ map_back.T + CENTER + shift
    value = sum(np.sin(w.real * at[..., 0] + w.imag * at[..., 1] + p) for w, p in zip(waves, phase, strict=True))
    return np.clip(np.rint(lift + gain * (128 + 14 * np.asarray(value))), 0, 255).astype(np.uint8)


def points(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((25, 25), (WIDTH - 25, HEIGHT - 25), (count, 2)).astype(np.float32)


@pytest.mark.parametrize(("gain", "lift"), [(1.0, 0.0), (0.7, 40.0)])
def test_finds_an_affine_warp_whatever_the_brightness(gain: float, lift: float) -> None:
    stretch, shift = np.array([[1.08, 0.06], [-0.05, 0.95]]), np.array([0.7, -0.4])
    first, second = textured(np.eye(2), np.zeros(2)), textured(np.linalg.inv(stretch), shift, gain, lift)
    at = points(60)
    truth = (at - CENTER - shift) @ stretch.T + CENTER
    start = np.concatenate(
        (truth + np.random.default_rng(1).uniform(-0.8, 0.8, at.shape), np.tile(IDENTITY, (60, 1))), 1
    )
    warp, correlation = register(cut_templates(first, at, 15), np.arange(60), second, start)
    error = np.linalg.norm(warp[:, :2] - truth, axis=1)
    assert np.median(error) < 0.05
    assert np.quantile(error, 0.95) < 0.2
    assert correlation.min() > 0.98
    assert np.abs(warp[:, 2:] - stretch.ravel()).mean() < 0.02


def test_the_extension_and_numpy_agree() -> None:
    if not is_fast():
        pytest.skip("the C++ extension is not installed")
    first, second = (
        textured(np.eye(2), np.zeros(2)),
        textured(np.array([[1.05, 0.1], [-0.1, 0.97]]), np.array([1.0, 0.3])),
    )
    second = np.clip(second + np.random.default_rng(0).normal(0, 4, second.shape), 0, 255).astype(np.uint8)
    first[:40, :50] = 90  # no contrast there
    at = np.concatenate((points(900), np.array([[0.0, 0.0], [159, 119], [3.2, 60], [80, 118.5], [20, 20]], np.float32)))
    start = np.concatenate((at + np.random.default_rng(1).uniform(-2, 2, at.shape), np.tile(IDENTITY, (len(at), 1))), 1)
    start[3] = [-50, 20, 1, 0, 0, 1]
    start[4, 2:] = [3, 0, 0, 3]
    rows = np.random.default_rng(2).permutation(len(at))
    templates = cut_templates(first, at, 15)
    one, other = (register(templates, rows, second, start[rows], use_extension=choice) for choice in (True, False))
    np.testing.assert_array_equal(one[1] < 0, other[1] < 0)
    used = one[1] >= 0
    assert 0.5 < used.mean() < 1.0
    apart = np.abs(one[0] - other[0])[used].max(axis=1)
    # Where a step is about as long as the one that ends the search, the two may stop at different ones.
    assert np.quantile(apart, 0.99) < 1e-4
    assert apart.max() < 0.03
    np.testing.assert_allclose(one[1], other[1], atol=1e-3)


def test_no_contrast_and_no_image_have_no_correlation() -> None:
    image = textured(np.eye(2), np.zeros(2))
    flat = np.full_like(image, 90)
    at = points(5)
    start = np.concatenate((at, np.tile(IDENTITY, (5, 1))), 1)
    assert (register(cut_templates(flat, at, 15), np.arange(5), image, start)[1] == -1).all()
    assert (register(cut_templates(image, at, 15), np.arange(5), flat, start)[1] == -1).all()
    start[:, 0] += 500
    assert (register(cut_templates(image, at, 15), np.arange(5), image, start)[1] == -1).all()
    assert len(register(cut_templates(image, at[:0], 15), np.arange(0), image, start[:0])[1]) == 0


def test_templates_are_cut_between_pixels_and_empty_outside() -> None:
    image = textured(np.eye(2), np.zeros(2))
    template = cut_templates(image, np.array([[30.25, 40.5], [2.0, 60.0], [-2.5, 60.0]], np.float32), 5)
    assert template.shape == (3, 7, 7)
    expected = cv2.getRectSubPix(image, (7, 7), (30.25, 40.5), patchType=cv2.CV_32F)
    np.testing.assert_allclose(template[0], expected, atol=1e-3)
    assert np.isnan(template[1][:, 0]).all()
    assert np.isfinite(template[1][:, 1:]).all()
    assert np.isnan(template[2]).all()


def motion(t: int) -> tuple[FloatArray, FloatArray]:
    """A slow turn, zoom and shift."""
    angle, scale = 0.008 * t, 1.004**t
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return scale * rotation, np.array([0.11 * t, -0.07 * t])


def noisy_images() -> ImageArray:
    """The texture under that motion, with noise."""
    images, noise = [], np.random.default_rng(3)
    for t in range(FRAMES):
        stretch, shift = motion(t)
        exact = textured(np.linalg.inv(stretch), shift).astype(float)
        images.append(np.clip(exact + noise.normal(0, 3, exact.shape), 0, 255).astype(np.uint8))
    return np.stack(images)


def drift_of(first: Float32Array | FloatArray, last: Float32Array | FloatArray) -> float:
    """Median distance of points (N, 2) px in the last image from where those of the first one went."""
    stretch, shift = motion(FRAMES - 1)
    truth = (first - CENTER - shift) @ stretch.T + CENTER
    return float(np.median(np.linalg.norm(last - truth, axis=1)))


def following(every: int) -> TrackingConfig:
    """Points whose first views are looked for every so many steps; 0: steps alone."""
    return TrackingConfig(
        grid_columns=12, grid_rows=9, query_interval=100, margin_px=30, reseed_spacing=None,
        refine="on" if every else "off", refine_every=max(every, 1),
    )  # fmt: skip


def test_errors_do_not_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 40 frames with noise steps drift, points that are found again do not."""
    images = noisy_images()
    looked_for: list[int] = []

    def counted(templates: Float32Array, rows: IntArray, *rest: Any) -> tuple[FloatArray, FloatArray]:
        looked_for.append(len(rows))
        return register(templates, rows, *rest)

    monkeypatch.setattr("uni4d_fg.frontend.tracks.first_views.register", counted)
    drift: dict[int, float] = {}
    number: dict[int, int] = {}
    for every in (1, 4, 0):
        looked_for.clear()
        tracks = track_grid(ArrayFrames(images), following(every))
        seen = tracks.visible[:, -1]
        assert seen.mean() > 0.9
        drift[every] = drift_of(tracks.uv[seen, 0], tracks.uv[seen, -1])
        number[every] = sum(looked_for)
    assert drift[1] < 0.08
    assert drift[1] < 0.5 * drift[0]
    assert drift[4] < 0.1
    assert drift[4] < 0.6 * drift[0]
    assert number[0] == 0
    assert 0.23 < number[4] / number[1] < 0.3


def test_errors_do_not_add_up_in_a_stream() -> None:
    images, drift = noisy_images(), {}
    for every in (1, 4, 0):
        tracker = OnlineTracker(following(every), max_tracks=200)
        first, *_, last = [tracker.advance(image) for image in images]
        assert len(last.track) > 0.9 * len(first.track)
        drift[every] = drift_of(first.uv[np.isin(first.track, last.track)], last.uv)
    assert drift[1] < 0.08
    assert drift[1] < 0.5 * drift[0]
    assert drift[4] < 0.1
    assert drift[4] < 0.6 * drift[0]
