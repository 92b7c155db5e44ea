"""Tracks that are worse than others count less in the second solve of bundle adjustment."""

from __future__ import annotations

import numpy as np
import pytest
from stage_samples import K, camera_path, observe, shift, static_observations, static_points

from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.geometry.alignment import align_points
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, adjust_bundle
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.stages.track_noise import relative_variance
from uni4d_fg.slam.stages.weights import weigh_by_residuals

FRAMES, TRACKS = 10, 300
POSES = camera_path(FRAMES)
STILL = {"camera_motion": {"rotation_weight": 0.0, "translation_weight": 0.0}}


def config(**fields: object) -> BundleAdjustmentConfig:
    return BundleAdjustmentConfig.model_validate(STILL | fields)


def seen_with(rng: np.random.Generator, sliding: np.ndarray) -> Observations:
    """Observations with a noise of 0.1 px, of tracks that slide by 0.5 px per frame where ``sliding`` (K,)."""
    step = rng.normal(scale=0.5, size=(TRACKS, FRAMES, 2)) * (np.arange(FRAMES)[:, None] > 0)
    slide = np.where(sliding[:, None, None], np.cumsum(step, axis=1), 0.0)
    noise = rng.normal(scale=0.1, size=(TRACKS, FRAMES, 2))
    return static_observations(shift(observe(static_points(rng, TRACKS), POSES), slide + noise))


def ate(observations: Observations, settings: BundleAdjustmentConfig) -> float:
    start = Cameras(POSES, K, np.zeros(FRAMES))
    scene = adjust_bundle(observations, start, K, settings, Freedom(poses=True, intrinsics=True))
    found, true = scene.cameras.world_T_cam[:, :3, 3], POSES[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum((align_points(found, true).apply(found) - true) ** 2, axis=1))))


def test_the_variance_lies_between_that_of_all_and_that_of_the_track() -> None:
    squared = np.concatenate([np.full(10, 0.2), np.full(10, 2.0), np.full(10, 8.0), np.full(3, 1e6)])
    row = np.repeat([0, 1, 2, 3], [10, 10, 10, 3])
    variance = relative_variance(squared, row, prior_dof=6.0)
    # Of 20 and 6 components, three went into the landmark; single observations are cut at five sigmas.
    own = np.array([2.0 / 17, 20.0 / 17, 80.0 / 17, 75.0 / 3])
    np.testing.assert_allclose(variance, (6.0 + 2.0 * own) / 8.0)
    np.testing.assert_allclose(relative_variance(squared, row, prior_dof=1e12), 1.0, rtol=1e-10)


def test_where_half_of_the_tracks_slide_the_cameras_are_a_fifth_better() -> None:
    ratios = []
    for seed in range(4):
        observations = seen_with(np.random.default_rng(seed), np.arange(TRACKS) % 2 == 0)
        ratios.append(ate(observations, config()) / ate(observations, config(track_noise_dof=None)))
    assert np.exp(np.mean(np.log(ratios))) < 0.8


def test_tracks_that_are_alike_cost_the_cameras_nothing() -> None:
    ratios = []
    for seed in range(4):
        observations = seen_with(np.random.default_rng(seed), np.zeros(TRACKS, np.bool_))
        ratios.append(ate(observations, config()) / ate(observations, config(track_noise_dof=None)))
    assert np.exp(np.mean(np.log(ratios))) < 1.02


def test_tracks_that_are_alike_keep_their_weights() -> None:
    observations = seen_with(np.random.default_rng(7), np.zeros(TRACKS, np.bool_))
    scene = adjust_bundle(
        observations, Cameras(POSES, K, np.zeros(FRAMES)), K, config(), Freedom(poses=True, intrinsics=True)
    )
    factor = weigh_by_residuals(scene.state(), observations, config()).weight / observations.weight
    assert np.median(factor) == pytest.approx(1.0, abs=1e-9)
    assert factor.min() > 0.7
    assert factor.max() < 1.3
    np.testing.assert_array_equal(
        weigh_by_residuals(scene.state(), observations, config(track_noise_dof=None)).weight, observations.weight
    )
