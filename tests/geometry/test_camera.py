"""The pinhole camera: round trips, parity with GTSAM's, NumPy and torch, behavior behind the camera."""

from __future__ import annotations

import gtsam
import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import (
    NEAR_PLANE,
    camera_to_world,
    inverse_depth,
    inverse_depth_slope,
    project,
    unproject,
    world_to_camera,
)

K = np.array([520.0, 510.0, 318.5, 241.25])


@settings(max_examples=100, deadline=None)
@given(st.floats(-500, 1200), st.floats(-500, 1200), st.floats(NEAR_PLANE, 1e3))
def test_projecting_a_lifted_pixel_returns_it(u: float, v: float, depth: float) -> None:
    uv = np.array([u, v])
    point = unproject(K, uv, np.float64(depth))
    assert point[2] == depth
    np.testing.assert_allclose(project(K, point), uv, atol=1e-9)


def test_projection_is_gtsams(rng: np.random.Generator) -> None:
    calibration = gtsam.Cal3_S2(K[0], K[1], 0.0, K[2], K[3])
    poses = se3.se3_exp(rng.normal(scale=0.5, size=(30, 6)))
    points = camera_to_world(poses, rng.uniform([-1, -1, 0.5], [1, 1, 6], size=(30, 3)))
    uv = project(K, world_to_camera(poses, points))
    for pose, point, pixel in zip(poses, points, uv, strict=True):
        camera = gtsam.PinholeCameraCal3_S2(gtsam.Pose3(pose), calibration)
        np.testing.assert_allclose(pixel, camera.project(point), atol=1e-9)
        depth = world_to_camera(pose, point)[2]
        lifted = camera_to_world(pose, unproject(K, pixel, depth))
        np.testing.assert_allclose(lifted, camera.backproject(pixel, depth), atol=1e-10)


def test_world_and_camera_frames_are_inverse(rng: np.random.Generator) -> None:
    pose, point = se3.se3_exp(rng.normal(size=(10, 6))), rng.normal(size=(10, 3))
    np.testing.assert_allclose(camera_to_world(pose, world_to_camera(pose, point)), point, atol=1e-13)
    expected = np.array([gtsam.Pose3(t).transformTo(p) for t, p in zip(pose, point, strict=True)])
    np.testing.assert_allclose(world_to_camera(pose, point), expected, atol=1e-13)


def test_torch_returns_the_same_numbers(rng: np.random.Generator) -> None:
    pose, point = se3.se3_exp(rng.normal(scale=0.2, size=(12, 6))), rng.normal(size=(12, 3))
    uv, depth = rng.uniform(0, 640, size=(12, 2)), rng.uniform(0.1, 4, size=12)
    t = torch.from_numpy
    for ours, theirs in (
        (world_to_camera(pose, point), world_to_camera(t(pose), t(point))),
        (camera_to_world(pose, point), camera_to_world(t(pose), t(point))),
        (project(K, point), project(t(K), t(point))),
        (unproject(K, uv, depth), unproject(t(K), t(uv), t(depth))),
        (inverse_depth_slope(point[:, 2]), inverse_depth_slope(t(point[:, 2]))),
    ):
        np.testing.assert_allclose(theirs.numpy(), ours, rtol=1e-13, atol=1e-10)


def test_shapes_broadcast() -> None:
    assert project(K, np.ones((4, 5, 3))).shape == (4, 5, 2)
    assert unproject(K, np.ones((4, 5, 2)), np.ones((4, 5))).shape == (4, 5, 3)
    assert world_to_camera(np.eye(4), np.ones((4, 5, 3))).shape == (4, 5, 3)


def test_inverse_depth_is_exact_in_front_and_linear_behind() -> None:
    z = np.array([NEAR_PLANE, 0.5, 2.0])
    np.testing.assert_array_equal(inverse_depth(z), 1.0 / z)
    np.testing.assert_allclose(
        inverse_depth(np.array([0.0, -1.0])), (2 * NEAR_PLANE - np.array([0, -1])) / NEAR_PLANE**2
    )
    z = np.linspace(-1.0, 3.0, 401) + 1e-4
    step = 1e-7
    numerical = (inverse_depth(z + step) - inverse_depth(z - step)) / (2 * step)
    np.testing.assert_allclose(inverse_depth_slope(z), numerical, rtol=1e-5)
    assert (np.diff(inverse_depth(z)) < 0).all()


def test_a_missing_depth_stays_missing() -> None:
    nan = np.array([np.nan])
    assert np.isnan(inverse_depth(nan)).all()
    assert np.isnan(unproject(K, np.zeros((1, 2)), nan)).all()
    assert np.isnan(project(K, np.array([[0.0, 0.0, np.nan]]))).all()
