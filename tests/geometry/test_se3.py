"""SE(3) against gtsam.Pose3: exponential, logarithm, retraction, inverse, projection onto rotations."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.geometry import se3

finite = st.floats(-3.0, 3.0, allow_nan=False, width=64)
twists = st.lists(finite, min_size=6, max_size=6).map(np.array)


def gtsam_exp(xi: np.ndarray) -> np.ndarray:
    return gtsam.Pose3.Expmap(xi).matrix()


@settings(max_examples=200, deadline=None)
@given(twists)
def test_exponential_is_gtsams(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.se3_exp(xi), gtsam_exp(xi), atol=1e-12)
    np.testing.assert_allclose(se3.so3_exp(xi[:3]), gtsam.Rot3.Expmap(xi[:3]).matrix(), atol=1e-13)


@settings(max_examples=100, deadline=None)
@given(twists, twists)
def test_retraction_is_gtsams(start: np.ndarray, xi: np.ndarray) -> None:
    pose = gtsam.Pose3.Expmap(start)
    np.testing.assert_allclose(se3.retract(pose.matrix(), xi), pose.retract(xi).matrix(), atol=1e-11)


@settings(max_examples=100, deadline=None)
@given(twists)
def test_inverse_undoes_a_transform(xi: np.ndarray) -> None:
    transform = se3.se3_exp(xi)
    np.testing.assert_allclose(se3.inverse(transform) @ transform, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(transform), gtsam.Pose3(transform).inverse().matrix(), atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(st.lists(finite, min_size=3, max_size=3).map(np.array))
def test_logarithm_undoes_the_exponential(omega: np.ndarray) -> None:
    angle = np.linalg.norm(omega)
    if angle >= np.pi - 1e-6:
        omega = omega * (np.pi - 1e-6) / angle
    np.testing.assert_allclose(se3.so3_log(se3.so3_exp(omega)), omega, atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-8, 0.99e-6, 1.01e-6, 1e-5, 1e-3, 0.1])
def test_small_angles_keep_full_precision(angle: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    xi = np.concatenate([angle * axis, [1.0, -2.0, 0.5]])
    w = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]) * angle
    left = np.eye(3) + w / 2 + w @ w / 6 + w @ w @ w / 24 + w @ w @ w @ w / 120
    np.testing.assert_allclose(se3.se3_exp(xi)[:3, 3], left @ xi[3:], atol=1e-9 * angle**3 + 4e-16)
    rotation = np.eye(3) + w + w @ w / 2 + w @ w @ w / 6 + w @ w @ w @ w / 24
    np.testing.assert_allclose(se3.so3_exp(xi[:3]), rotation, atol=1e-2 * angle**4 + 4e-16)


def test_half_turn() -> None:
    omega = np.pi * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.0, 0.8]])
    rotation = se3.so3_exp(omega)
    np.testing.assert_allclose(rotation @ rotation, np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(se3.so3_log(rotation), axis=1), np.pi, atol=1e-7)


def test_any_batch_shape(rng: np.random.Generator) -> None:
    xi = rng.normal(size=(2, 3, 6))
    batched = se3.se3_exp(xi)
    assert batched.shape == (2, 3, 4, 4)
    assert se3.so3_log(batched[..., :3, :3]).shape == (2, 3, 3)
    for i in np.ndindex(2, 3):
        np.testing.assert_array_equal(batched[i], se3.se3_exp(xi[i]))
    assert se3.se3_exp(np.zeros((0, 6))).shape == (0, 4, 4)


def test_zero_step_changes_no_bit(rng: np.random.Generator) -> None:
    pose = se3.se3_exp(rng.normal(size=(20, 6)))
    np.testing.assert_array_equal(se3.retract(pose, np.zeros((20, 6))), pose)


def test_orthonormalize_returns_the_nearest_rotation(rng: np.random.Generator) -> None:
    transform = se3.se3_exp(rng.normal(size=(20, 6)))
    np.testing.assert_allclose(se3.orthonormalize(transform), transform, atol=1e-14)
    noisy = transform.copy()
    noisy[:, :3, :3] += rng.normal(scale=0.05, size=(20, 3, 3))
    fixed = se3.orthonormalize(noisy)
    rotation = fixed[:, :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-14)
    np.testing.assert_array_equal(fixed[:, :3, 3], transform[:, :3, 3])
    distance = np.linalg.norm(rotation - noisy[:, :3, :3], axis=(1, 2))
    for _ in range(20):
        other = rotation @ se3.so3_exp(rng.normal(scale=0.05, size=(20, 3)))
        assert (np.linalg.norm(other - noisy[:, :3, :3], axis=(1, 2)) >= distance).all()


def test_orthonormalize_turns_a_reflection_into_a_rotation() -> None:
    transform = np.diag([1.0, 1.0, -0.9, 1.0])
    rotation = se3.orthonormalize(transform)[:3, :3]
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-14)
