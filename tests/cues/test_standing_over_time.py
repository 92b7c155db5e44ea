"""Where a thing stands, from where its masks end, while its apparent size goes astray."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.cues.standing_over_time import standing_over_time

WHOLE = np.zeros(60, bool)


def cost(found: FloatArray, seen: FloatArray, is_bound: BoolArray) -> float:
    """What is minimized."""
    beyond = seen - found
    far = np.where(is_bound, 0.0, -beyond / 0.3)
    return float(np.where(beyond > 0, beyond / 0.1, far).sum() + (np.diff(found) ** 2).sum() / (2 * 0.005**2))


def test_what_is_seen_alike_in_all_frames_stays() -> None:
    np.testing.assert_allclose(standing_over_time(np.full(60, -1.6), WHOLE), -1.6, atol=1e-9)
    np.testing.assert_allclose(standing_over_time(np.array([0.3]), np.zeros(1, bool)), 0.3)


def test_a_size_that_goes_astray_is_followed(rng: np.random.Generator) -> None:
    drift = 0.4 * np.sin(np.linspace(0, np.pi, 200))
    seen = drift + rng.normal(0, 0.01, 200)
    found = standing_over_time(seen, np.zeros(200, bool))
    assert np.abs(found - drift).mean() < 0.05
    assert np.abs(np.quantile(seen, 0.75) - drift).mean() > 0.12  # what one value for all frames is off by


@pytest.mark.parametrize("lost", [0.2, 0.4, 0.6])
def test_frames_that_lose_feet_are_no_farther(lost: float, rng: np.random.Generator) -> None:
    drift = np.linspace(0, 0.05, 60)
    seen = drift - np.where(rng.random(60) < lost, 0.4, 0.0)
    assert np.abs(standing_over_time(seen, WHOLE) - drift).max() < 0.035


def test_what_the_image_cuts_off_is_nearer_by_any_factor() -> None:
    is_bound = np.arange(60) >= 30
    seen = np.where(is_bound, -0.02 * np.arange(-30, 30), 0.0)  # it comes near: the border is at a constant distance
    found = standing_over_time(seen, is_bound)
    np.testing.assert_allclose(found, 0.0, atol=1e-3)
    assert standing_over_time(seen, WHOLE)[-1] < -0.04
    above = np.where(is_bound, 0.3, 0.0)  # nothing is farther than what it hides
    assert standing_over_time(above, is_bound)[-1] > 0.1


def test_nothing_near_it_costs_less(rng: np.random.Generator) -> None:
    for _ in range(20):
        frames = int(rng.integers(2, 60))
        seen = rng.normal(0, 0.1, frames) - 0.3 * (rng.random(frames) < 0.3)
        is_bound = rng.random(frames) < 0.3
        is_bound[0] = False
        found = standing_over_time(seen, is_bound)
        least = cost(found, seen, is_bound)
        for scale in (1e-3, 1e-2, 1e-1):
            for _ in range(20):
                # Errors of a thousandth that least squares leave cost up to a hundredth per frame.
                assert least < cost(found + rng.normal(0, scale), seen, is_bound) + 0.01 * frames
                moved = found + scale * np.cumsum(rng.normal(0, 0.1, frames))
                assert least < cost(moved, seen, is_bound) + 0.01 * frames
