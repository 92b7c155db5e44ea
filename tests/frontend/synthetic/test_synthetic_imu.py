"""The simulated IMU agrees with the derivatives of the path, and nothing is seen in a blackout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.frontend.synthetic.blackout import black_out
from uni4d_fg.frontend.synthetic.camera_path import camera_path
from uni4d_fg.frontend.synthetic.imu import WORLD_GRAVITY, SmoothPath, simulate_imu
from uni4d_fg.geometry import se3

TIMES = np.arange(20) / 15.0
POSES = camera_path("handheld", TIMES, 0.8)


def test_the_path_passes_through_the_poses_and_its_derivatives_are_those_of_differences() -> None:
    path = SmoothPath(TIMES, POSES)
    np.testing.assert_allclose(path.motion(TIMES).world_T_cam, POSES, atol=1e-12)
    times, h = np.linspace(0.11, 1.19, 40), 1e-5
    now, before, after = path.motion(times), path.motion(times - h), path.motion(times + h)
    position = [m.world_T_cam[:, :3, 3] for m in (before, now, after)]
    np.testing.assert_allclose((position[2] - position[0]) / (2 * h), now.velocity, atol=1e-6)
    np.testing.assert_allclose((after.velocity - before.velocity) / (2 * h), now.acceleration, atol=1e-5)
    twist = se3.so3_log(np.swapaxes(before.world_T_cam[:, :3, :3], 1, 2) @ after.world_T_cam[:, :3, :3])
    np.testing.assert_allclose(twist / (2 * h), now.rate, atol=1e-6)
    np.testing.assert_allclose((after.rate - before.rate) / (2 * h), now.rate_change, atol=1e-4)


def test_exact_samples_are_the_motion_of_the_body() -> None:
    """Checked against the body's own path: its positions are differentiated twice."""
    body_T_cam = se3.se3_exp(np.array([0.3, -0.2, 1.0, 0.1, 0.05, -0.2]))
    imu = simulate_imu(TIMES, POSES, noise=None, body_T_cam=body_T_cam, seed=3)
    inner = slice(2, -2)
    times, h = imu.samples.timestamps[inner], 1e-4
    bodies = [imu.path.motion(times + k * h).world_T_cam @ se3.inverse(body_T_cam) for k in (-1, 0, 1)]
    acceleration = (bodies[0][:, :3, 3] - 2 * bodies[1][:, :3, 3] + bodies[2][:, :3, 3]) / h**2
    force = np.einsum("nij,ni->nj", bodies[1][:, :3, :3], acceleration - WORLD_GRAVITY)
    np.testing.assert_allclose((imu.samples.accelerometer - imu.accelerometer_bias)[inner], force, atol=1e-3)
    turn = se3.so3_log(np.swapaxes(bodies[0][:, :3, :3], 1, 2) @ bodies[2][:, :3, :3]) / (2 * h)
    np.testing.assert_allclose((imu.samples.gyroscope - imu.gyroscope_bias)[inner], turn, atol=1e-6)


def test_the_lever_arm_is_undone() -> None:
    body_T_cam = se3.se3_exp(np.array([0.3, -0.2, 1.0, 0.1, 0.05, -0.2]))
    plain = simulate_imu(TIMES, POSES, noise=None, accelerometer_bias=0.0, gyroscope_bias=0.0)
    away = simulate_imu(TIMES, POSES, noise=None, accelerometer_bias=0.0, gyroscope_bias=0.0, body_T_cam=body_T_cam)
    moved, inner = away.samples.at_camera(), slice(1, -1)
    before, after = (
        (imu.accelerometer - plain.samples.accelerometer)[inner]
        for imu in (replace(away.samples, accelerometer=away.samples.accelerometer @ body_T_cam[:3, :3]), moved)
    )
    assert np.sqrt(np.mean(before**2)) > 0.1
    assert np.sqrt(np.mean(after**2)) < 0.003  # differences across the knots of the path, where the jerk jumps
    assert np.abs(np.cumsum(after, axis=0) / 200.0).max() < 5e-4  # of the velocity, m/s
    np.testing.assert_allclose(moved.gyroscope, plain.samples.gyroscope, atol=1e-12)


def test_noise_has_the_stated_density_and_biases_walk() -> None:
    imu = simulate_imu(np.arange(600) / 15.0, camera_path("static", np.arange(600) / 15.0, 0.0), seed=1)
    noise, rate = imu.samples.noise, 200.0
    white = imu.samples.accelerometer - imu.accelerometer_bias - (imu.samples.accelerometer).mean(axis=0)
    white = white - white.mean(axis=0)
    assert white.std() == pytest.approx(noise.accelerometer * np.sqrt(rate), rel=0.05)
    assert np.diff(imu.gyroscope_bias, axis=0).std() == pytest.approx(noise.gyroscope_walk / np.sqrt(rate), rel=0.05)


def test_nothing_is_seen_in_a_blackout_and_no_track_survives() -> None:
    config = SyntheticSceneConfig(
        num_frames=12, height=60, width=80, focal=75.0, grid_columns=10, grid_rows=8, margin_px=3.0,
        render_images=False,
    )  # fmt: skip
    before = make_synthetic_sequence(config)
    after = black_out(before, 5, 3)
    assert before.tracks is not None
    assert after.tracks is not None
    visible = after.tracks.visible
    assert not visible[:, 5:8].any()
    assert not (visible[:, :5].any(axis=1) & visible[:, 8:].any(axis=1)).any()
    assert visible.sum() == before.tracks.visible[:, [0, 1, 2, 3, 4, 8, 9, 10, 11]].sum()
    assert visible[np.arange(len(visible)), after.tracks.query_frame].all()
    assert np.isnan(after.depths[6]).all()
    assert after.ground_truth.track_points is not None
    assert len(after.ground_truth.track_points) == after.tracks.num_tracks
    with pytest.raises(ValueError, match="not inside"):
        black_out(before, 9, 3)
