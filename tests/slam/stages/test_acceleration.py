"""The prior on the camera's acceleration, and its strength from the sequence itself."""

from __future__ import annotations

import numpy as np
import pytest
from stage_samples import K, observe, shift, static_observations, static_points

from uni4d_fg.config.stages import AccelerationConfig, BundleAdjustmentConfig
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.geometry import se3
from uni4d_fg.slam.stages import acceleration
from uni4d_fg.slam.stages.acceleration import AccelerationPrior, starting_prior, variance_component
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, adjust_bundle
from uni4d_fg.slam.stages.scene import Cameras, StaticScene

FRAMES, RATE = 24, 15.0
LINEAR, ANGULAR = 1.5, 0.8
"""m/s^2 and rad/s^2 of the path of these tests, at RATE frames a second."""


def path(rng: np.random.Generator, linear: float = LINEAR, angular: float = ANGULAR) -> np.ndarray:
    """Accelerations that are independent from frame to frame."""
    step = 1.0 / RATE
    velocity = np.cumsum(rng.normal(scale=linear, size=(FRAMES, 3)), axis=0) * step
    velocity += [0.3, 0.0, 0.0] - velocity.mean(axis=0)
    spin = np.cumsum(rng.normal(scale=angular, size=(FRAMES, 3)), axis=0) * step
    spin -= spin.mean(axis=0)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    for t in range(1, FRAMES):
        poses[t, :3, :3] = poses[t - 1, :3, :3] @ se3.so3_exp(spin[t][None] * step)[0]
        poses[t, :3, 3] = poses[t - 1, :3, 3] + velocity[t] * step
    return poses


def solved(seed: int, poses: np.ndarray, noise_px: float = 0.5, rate: float = RATE, **fields: object) -> StaticScene:
    rng = np.random.default_rng(seed)
    seen = observe(static_points(rng, 150), poses)
    seen = shift(seen, rng.normal(scale=noise_px, size=seen.tracks.uv.shape))
    start = Cameras(poses, K.copy(), np.zeros(len(poses)))
    config = BundleAdjustmentConfig.model_validate({"structure": "keep", "covariance_cells": 0, **fields})
    times = np.arange(len(poses)) / rate
    return adjust_bundle(
        static_observations(seen), start, K, config, Freedom(poses=True, intrinsics=False), timestamps=times
    )


def residuals(poses: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    angular, linear = (batch.residual(State({POSE: poses})) for batch in AccelerationPrior(times, 1.0, 1.0).terms())
    return angular, linear


def test_a_constant_acceleration_is_found_at_uneven_times() -> None:
    times = np.array([0.0, 0.05, 0.2, 0.23, 0.5, 0.6])
    linear, angular = np.array([0.4, -1.0, 2.0]), np.array([0.0, 3.0, 0.0])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = [0.1, 0.2, 0.3] + np.outer(times, [1.0, 0.0, -0.5]) + 0.5 * np.outer(times**2, linear)
    poses[:, :3, :3] = se3.so3_exp(np.outer(0.5 * times**2 + 0.2 * times, angular))
    found_angular, found_linear = residuals(poses, times)
    np.testing.assert_allclose(found_linear, np.tile(linear, (4, 1)), atol=1e-9)
    np.testing.assert_allclose(found_angular, np.tile(angular, (4, 1)), atol=1e-9)


def test_too_few_frames_have_no_acceleration() -> None:
    assert AccelerationPrior(np.array([0.0, 1.0]), 1.0, 1.0).terms() == []
    assert AccelerationPrior(np.arange(4.0), None, None).terms() == []


@pytest.mark.parametrize("truth", [0.5, 1.0, 3.0])
def test_the_noise_is_not_taken_for_motion(truth: float, rng: np.random.Generator) -> None:
    noise = rng.uniform(0.1, 4.0, size=6000)
    y = rng.normal(size=6000) * np.sqrt(truth**2 + noise)
    assert variance_component(y, noise) == pytest.approx(truth, rel=0.3)


def test_noise_alone_ends_at_the_floor(rng: np.random.Generator) -> None:
    noise = np.full(600, 4.0)
    y = 0.9 * rng.normal(size=600) * 2.0
    assert variance_component(y, noise) == pytest.approx(0.2, rel=0.05)


def test_the_strength_is_that_of_the_path(rng: np.random.Generator) -> None:
    found = solved(1, path(rng)).acceleration
    assert found is not None
    assert not found.is_weak
    assert found.linear == pytest.approx(LINEAR, rel=0.25)
    assert found.angular == pytest.approx(ANGULAR, rel=0.25)


def test_the_unit_of_time_does_not_matter(rng: np.random.Generator) -> None:
    poses = path(rng)
    slow, fast = solved(2, poses), solved(2, poses, rate=100 * RATE)
    assert slow.acceleration is not None
    assert fast.acceleration is not None
    assert fast.acceleration.linear == pytest.approx(1e4 * slow.acceleration.linear, rel=1e-3)
    np.testing.assert_allclose(slow.cameras.world_T_cam, fast.cameras.world_T_cam, atol=1e-6)


def test_the_weak_prior_is_taken_out(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    poses, found = path(rng), []
    for weak in (0.03, 1.0):
        monkeypatch.setattr(acceleration, "_WEAK", weak)
        found.append(solved(3, poses).acceleration)
    assert found[0] is not None
    assert found[1] is not None
    assert found[0].linear == pytest.approx(found[1].linear, rel=0.02)
    assert found[0].angular == pytest.approx(found[1].angular, rel=0.02)


def test_frames_in_parts_say_the_same(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = path(rng)
    whole = solved(4, poses).acceleration
    monkeypatch.setattr(acceleration, "_CHUNK", 12)
    parts = solved(4, poses).acceleration
    assert whole is not None
    assert parts is not None
    assert parts.linear == pytest.approx(whole.linear, rel=0.2)
    assert parts.angular == pytest.approx(whole.angular, rel=0.2)


def test_a_camera_at_rest_is_held_still() -> None:
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    spread = {}
    for name, given in (("auto", "auto"), ("off", None)):
        scene = solved(5, poses, acceleration={"linear": given, "angular": given})
        spread[name] = np.linalg.norm(np.diff(scene.cameras.world_T_cam[:, :3, 3], 2, axis=0), axis=1).mean()
    assert spread["auto"] < 0.3 * spread["off"]


def test_what_is_given_is_kept_and_null_is_off(rng: np.random.Generator) -> None:
    poses = path(rng)
    given = solved(6, poses, acceleration={"linear": 0.7, "angular": None}).acceleration
    assert given is not None
    assert (given.linear, given.angular, given.is_weak) == (0.7, None, ())
    config = AccelerationConfig(linear=0.7)
    unknown = starting_prior(config, None, poses, np.ones((3, 3)))
    assert unknown.is_weak == ("linear", "angular")
    assert AccelerationPrior.of_arrays(given.arrays()) is not None
    assert AccelerationPrior.of_arrays({}) is None


def test_exact_observations_leave_the_path_alone(rng: np.random.Generator) -> None:
    poses = path(rng)
    scene = solved(7, poses, noise_px=0.0)
    np.testing.assert_allclose(scene.cameras.world_T_cam, poses, atol=1e-5)
