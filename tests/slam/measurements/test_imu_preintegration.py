"""GTSAM's inertial factors vanish at the truth, and the alignment finds it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from imu_samples import Ride, ride, seen_by_cameras

from uni4d_fg.config.imu import ImuConfig
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.geometry import se3
from uni4d_fg.slam.measurements.imu_alignment import align_with_imu, visible_parts
from uni4d_fg.slam.measurements.imu_preintegration import preintegrate

CONFIG = ImuConfig()
DARK = slice(15, 25)


def predictions(truth: Ride) -> list[tuple[float, float, float]]:
    """Errors of rotation, velocity and position that the sums predict from the true state of each frame."""
    samples = truth.imu.samples.at_camera(truth.imu.gyroscope_bias[0])
    out = []
    for i, total in enumerate(preintegrate(samples, truth.times, truth.bias[0], CONFIG)):
        dt, pose = truth.times[i + 1] - truth.times[i], truth.world_T_cam[i]
        rotation = pose[:3, :3] @ total.deltaRij().matrix()
        velocity = truth.velocity[i] + truth.gravity * dt + pose[:3, :3] @ total.deltaVij()
        position = pose[:3, 3] + truth.velocity[i] * dt + 0.5 * truth.gravity * dt**2 + pose[:3, :3] @ total.deltaPij()
        after = truth.world_T_cam[i + 1]
        turn = se3.so3_log(after[:3, :3].T @ rotation)
        out.append(
            tuple(map(float, map(np.linalg.norm, (turn, velocity - truth.velocity[i + 1], position - after[:3, 3]))))
        )
    return out


def test_exact_samples_predict_the_next_frame_to_second_order() -> None:
    errors = [np.max(predictions(ride(noise=None, rate_hz=rate)), axis=0) for rate in (200.0, 400.0)]
    assert (errors[0] < [2e-5, 4e-3, 2e-4]).all()
    assert (errors[1] < 0.4 * errors[0]).all()


def test_inertial_factors_vanish_at_the_truth() -> None:
    truth = ride(noise=None, rate_hz=400.0)
    samples = truth.imu.samples.at_camera(truth.imu.gyroscope_bias[0])
    sums = preintegrate(samples, truth.times, truth.bias[0], CONFIG)
    values = gtsam.Values()
    values.insert(6, truth.gravity)
    for frame in (3, 4):
        values.insert(10 * frame, gtsam.Pose3(truth.world_T_cam[frame]))
        values.insert(10 * frame + 1, truth.velocity[frame])
        values.insert(10 * frame + 2, gtsam.imuBias.ConstantBias(truth.bias[0, :3], truth.bias[0, 3:]))
    found = gtsam.CombinedImuFactorWithGravityVector(30, 31, 40, 41, 32, 42, 6, sums[3])
    assert found.error(values) < 1.0
    values.update(41, truth.velocity[4] + [0.01, 0.0, 0.0])
    assert found.error(values) > 20.0


def test_the_alignment_finds_the_truth_from_exact_cameras() -> None:
    truth = ride(noise=None, rate_hz=400.0)
    poses, part = seen_by_cameras(truth, 1.7, 0.0, 0.0)
    found = align_with_imu(poses, part, truth.times, truth.imu.samples, CONFIG)
    assert found.scale == pytest.approx(1.7, rel=2e-3)
    np.testing.assert_allclose(found.gravity, truth.gravity, atol=0.02)
    np.testing.assert_allclose(found.world_T_cam, truth.world_T_cam, atol=5e-4)
    np.testing.assert_allclose(found.velocity, truth.velocity, atol=0.01)
    np.testing.assert_allclose(found.bias[3:], truth.bias[0, 3:], atol=1e-5)
    np.testing.assert_allclose(found.bias[:3], truth.bias[0, :3], atol=0.03)


@pytest.mark.parametrize("seed", range(4))
def test_the_alignment_bridges_a_blackout(seed: int) -> None:
    """Noisy cameras: the scale within what it says of itself, and what comes after the blackout put in its place."""
    truth = ride(seed=seed)
    poses, part = seen_by_cameras(truth, 0.6, 0.002, 0.001, DARK, seed)
    found = align_with_imu(poses, part, truth.times, truth.imu.samples, CONFIG)
    assert found.scale == pytest.approx(0.6, rel=0.02)
    assert abs(found.scale / 0.6 - 1.0) < 3.5 * found.scale_sigma
    assert 0.001 < found.scale_sigma < 0.02
    np.testing.assert_allclose(found.world_T_cam[0], np.eye(4), atol=1e-12)
    error = np.linalg.norm(found.world_T_cam[:, :3, 3] - truth.world_T_cam[:, :3, 3], axis=1)
    assert error.max() < 0.03
    turn = se3.so3_log(np.swapaxes(found.world_T_cam[:, :3, :3], 1, 2) @ truth.world_T_cam[:, :3, :3])
    assert np.linalg.norm(turn, axis=1).max() < 0.01
    cosine = found.gravity @ truth.gravity / np.linalg.norm(found.gravity) / np.linalg.norm(truth.gravity)
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 1.0
    assert np.linalg.norm(found.gravity) == pytest.approx(9.81, abs=0.03)


def test_what_cannot_be_aligned_is_said() -> None:
    truth = ride(seed=1)
    poses, part = seen_by_cameras(truth, 1.0, 0.0, 0.0)
    with pytest.raises(DegenerateProblemError, match="fewer than four frames"):
        align_with_imu(poses, np.full_like(part, -1), truth.times, truth.imu.samples, CONFIG)
    still = np.tile(poses[:1], (len(poses), 1, 1))
    with pytest.raises(DegenerateProblemError, match="IMU: "):
        align_with_imu(still, part, truth.times, truth.imu.samples, CONFIG)


def test_frames_are_joined_by_shared_tracks() -> None:
    track = np.repeat(np.arange(6), 2)
    frame = np.array([0, 2, 0, 2, 2, 3, 2, 3, 5, 6, 5, 6])
    np.testing.assert_array_equal(visible_parts(track, frame, 8, 2), [0, -1, 0, 0, -1, 1, 1, -1])
    np.testing.assert_array_equal(visible_parts(track, frame, 8, 3), np.full(8, -1))
