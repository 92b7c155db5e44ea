"""The depth cue's scale at moving points: the neighborhood is used exactly where it predicts better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.local_scale import predict_log_scale
from uni4d_fg.slam.stages.observations import Observations

FRAMES, PER_FRAME = 4, 400
FRAME_SCALE = np.array([0.05, -0.1, 0.0, 0.2])


def scattered(rng: np.random.Generator, per_frame: int) -> Observations:
    frame = np.repeat(np.arange(FRAMES), per_frame)
    count = len(frame)
    uv = rng.uniform([0, 0], [320, 240], size=(count, 2))
    return Observations(np.arange(count), frame, uv, np.ones(count), np.ones(count))


def smooth_field(observations: Observations) -> np.ndarray:
    """A field over the image, another one in each frame."""
    u, v = (observations.uv / [320.0, 240.0]).T
    return 0.04 * np.sin(4.0 * u + observations.frame) + 0.03 * np.cos(3.0 * v - 2.0 * observations.frame)


def test_a_smooth_field_is_predicted_better_than_by_the_frame(rng: np.random.Generator) -> None:
    static, queries = scattered(rng, PER_FRAME), scattered(rng, 50)
    measured = FRAME_SCALE[static.frame] + smooth_field(static) + rng.normal(scale=0.01, size=len(static))
    local = predict_log_scale(static, measured, FRAME_SCALE, queries, 24, 512)
    truth = FRAME_SCALE[queries.frame] + smooth_field(queries)
    error = local.log_scale - truth
    frame_error = FRAME_SCALE[queries.frame] - truth
    assert local.is_local
    assert local.sigma == pytest.approx(0.011, abs=0.002)
    assert local.frame_sigma > 0.03
    assert np.sqrt(np.mean(error**2)) < 0.25 * np.sqrt(np.mean(frame_error**2))


def test_what_is_far_from_the_static_scene_is_said_to_be_less_sure(rng: np.random.Generator) -> None:
    static, queries = scattered(rng, 4 * PER_FRAME), scattered(rng, 4 * PER_FRAME)
    center = np.array([160.0, 120.0])
    static = static.select(np.linalg.norm(static.uv - center, axis=1) > 70)
    queries = queries.select(np.linalg.norm(queries.uv - center, axis=1) < 65)
    measured = FRAME_SCALE[static.frame] + smooth_field(static) + rng.normal(scale=0.004, size=len(static))
    local = predict_log_scale(static, measured, FRAME_SCALE, queries, 24, 512)
    error = local.log_scale - FRAME_SCALE[queries.frame] - smooth_field(queries)
    assert local.is_local
    assert 0.6 < local.sigma / np.sqrt(np.mean(error**2)) < 1.6


def test_a_shift_of_disparity_is_not_taken_for_scale(rng: np.random.Generator) -> None:
    """What moves is nearer than what it is compared with, where scale and shift differ most."""
    static, queries = scattered(rng, PER_FRAME), scattered(rng, 50)
    shift = np.array([0.015, -0.015, 0.0, 0.01])

    def cue(true: np.ndarray, frame: np.ndarray) -> np.ndarray:
        return np.exp(-FRAME_SCALE[frame]) / (1.0 / true - shift[frame])

    true, near = rng.uniform(2.0, 8.0, len(static)), np.full(len(queries), 1.0)
    static = replace(static, depth=cue(true, static.frame))
    queries = replace(queries, depth=cue(near, queries.frame))
    measured = np.log(true / static.depth) + rng.normal(scale=0.01, size=len(static))
    medians = np.array([np.median(measured[static.frame == frame]) for frame in range(FRAMES)])
    local = predict_log_scale(static, measured, medians, queries, 24, 512)
    by_frame = np.log(queries.depth / near) + medians[queries.frame]
    assert np.sqrt(np.mean(by_frame**2)) > 0.04
    assert np.sqrt(np.mean((np.log(queries.depth / near) + local.log_scale) ** 2)) < 0.015


def test_little_is_taken_from_what_is_far_off(rng: np.random.Generator) -> None:
    """A field that changes within what the hole measures says nothing of its middle, and is not carried there."""
    static, queries = scattered(rng, 8 * PER_FRAME), scattered(rng, 8 * PER_FRAME)
    center = np.array([160.0, 120.0])
    waves, phase = rng.normal(scale=1.0 / 25.0, size=(FRAMES, 30, 2)), rng.uniform(0.0, 2.0 * np.pi, size=(FRAMES, 30))

    def field(observations: Observations) -> np.ndarray:
        """Return one that is alike over 25 px."""
        along = np.einsum("nwi,ni->nw", waves[observations.frame], observations.uv)
        return 0.01 * np.cos(along + phase[observations.frame]).sum(axis=1)

    static = static.select(np.linalg.norm(static.uv - center, axis=1) > 70)
    queries = queries.select(np.linalg.norm(queries.uv - center, axis=1) < 30)
    local = predict_log_scale(static, FRAME_SCALE[static.frame] + field(static), FRAME_SCALE, queries, 24, 512)
    assert robust_sigma(field(static)) > 0.03
    assert np.quantile(np.abs(local.log_scale - FRAME_SCALE[queries.frame]), 0.9) < 0.015
    beside = scattered(rng, 50)
    beside = beside.select(np.linalg.norm(beside.uv - center, axis=1) > 80)
    known = predict_log_scale(static, FRAME_SCALE[static.frame] + field(static), FRAME_SCALE, beside, 24, 512)
    error = known.log_scale - FRAME_SCALE[beside.frame] - field(beside)
    assert known.is_local
    assert robust_sigma(error) < 0.25 * robust_sigma(field(beside))


def test_many_static_observations_are_measured_on_a_sample(rng: np.random.Generator) -> None:
    static, queries = scattered(rng, 4000), scattered(rng, 50)
    measured = FRAME_SCALE[static.frame] + smooth_field(static) + rng.normal(scale=0.01, size=len(static))
    local = predict_log_scale(static, measured, FRAME_SCALE, queries, 24, 512)
    assert local.sigma == pytest.approx(0.01 * np.sqrt(1.0 + 0.5 * np.pi / 24), rel=0.05)  # a median of 24
    assert local.frame_sigma > 0.03


def test_white_noise_falls_back_to_the_scale_of_the_frame(rng: np.random.Generator) -> None:
    static, queries = scattered(rng, PER_FRAME), scattered(rng, 50)
    measured = FRAME_SCALE[static.frame] + rng.normal(scale=0.02, size=len(static))
    local = predict_log_scale(static, measured, FRAME_SCALE, queries, 24, 512)
    assert not local.is_local
    np.testing.assert_array_equal(local.log_scale, FRAME_SCALE[queries.frame])
    assert local.sigma == local.frame_sigma == pytest.approx(0.02, rel=0.1)


def test_no_neighbors_means_the_scale_of_the_frame(rng: np.random.Generator) -> None:
    static, queries = scattered(rng, PER_FRAME), scattered(rng, 10)
    local = predict_log_scale(static, smooth_field(static), FRAME_SCALE, queries, 0, 512)
    np.testing.assert_array_equal(local.log_scale, FRAME_SCALE[queries.frame])
    assert not local.is_local


def test_a_frame_with_too_few_static_observations_keeps_its_scale(rng: np.random.Generator) -> None:
    static, queries = scattered(rng, PER_FRAME), scattered(rng, 20)
    measured = FRAME_SCALE[static.frame] + smooth_field(static)
    measured[(static.frame == 2) & (np.arange(len(static)) % PER_FRAME >= 10)] = np.nan
    local = predict_log_scale(static, measured, FRAME_SCALE, queries, 24, 512)
    assert local.is_local
    sparse = queries.frame == 2
    np.testing.assert_array_equal(local.log_scale[sparse], FRAME_SCALE[2])
    assert (local.log_scale[~sparse] != FRAME_SCALE[queries.frame[~sparse]]).all()


def test_outliers_among_the_static_observations_hardly_matter(rng: np.random.Generator) -> None:
    static, queries = scattered(rng, PER_FRAME), scattered(rng, 50)
    measured = FRAME_SCALE[static.frame] + smooth_field(static)
    measured[rng.random(len(static)) < 0.1] += 1.0
    local = predict_log_scale(static, measured, FRAME_SCALE, queries, 24, 512)
    error = local.log_scale - FRAME_SCALE[queries.frame] - smooth_field(queries)
    assert local.is_local
    assert np.sqrt(np.mean(error**2)) < 0.015
    assert np.isfinite(local.log_scale).all()


def test_no_queries_give_no_prediction(rng: np.random.Generator) -> None:
    static = scattered(rng, 100)
    none = static.select(np.zeros(0, np.int64))
    assert predict_log_scale(static, smooth_field(static), FRAME_SCALE, none, 24, 512).log_scale.shape == (0,)
