"""The spread of depths about one point per track is the noise of the cue, and no scale of a frame adds to it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from stage_samples import K, camera_path, hide, observe, static_observations, static_points

from uni4d_fg.slam.stages.depth_spread import depth_spread
from uni4d_fg.slam.stages.scene import Cameras

FRAMES = 12


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.1])
def test_the_spread_is_the_noise(rng: np.random.Generator, sigma: float) -> None:
    poses = camera_path(FRAMES)
    seen = static_observations(observe(static_points(rng, 400), poses))
    cameras = Cameras(poses, K, np.zeros(FRAMES))
    assert depth_spread(seen, cameras) < 1e-6
    scale = np.exp(rng.normal(0, 0.1, FRAMES))[seen.frame]
    noisy = dataclasses.replace(seen, depth=seen.depth * scale * np.exp(rng.normal(0, sigma, len(seen))))
    # A twelfth of the variance is in the mean of twelve; scales move the mean point of all tracks by a little.
    assert depth_spread(noisy, cameras) == pytest.approx(sigma * np.sqrt(11 / 12), rel=0.1, abs=0.004)


def test_what_all_depths_of_a_track_share_is_not_seen(rng: np.random.Generator) -> None:
    poses = camera_path(FRAMES)
    seen = static_observations(observe(static_points(rng, 400), poses))
    shared = np.exp(rng.normal(0, 0.1, 400))[seen.track]
    spread = depth_spread(dataclasses.replace(seen, depth=seen.depth * shared), Cameras(poses, K, np.zeros(FRAMES)))
    assert spread < 0.02


def test_nothing_is_known_of_depths_in_two_frames(rng: np.random.Generator) -> None:
    poses = camera_path(FRAMES)
    labelled = observe(static_points(rng, 20), poses)
    two = static_observations(hide(labelled, np.arange(FRAMES)[None] > 1))
    assert np.isnan(depth_spread(two, Cameras(poses, K, np.zeros(FRAMES))))
