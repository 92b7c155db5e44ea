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


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 10**6), angle=st.floats(0.0, 3.1), reach=st.sampled_from([0.0, 1e-3, 1.0, 100.0]))
def test_relative_twist_and_inverse_jacobian_are_gtsams(seed: int, angle: float, reach: float) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    twist = np.concatenate([angle * axis / np.linalg.norm(axis), rng.normal(scale=reach, size=3)])
    back = se3.relative_twist(np.eye(4)[None], se3.se3_exp(twist[None]))[0]
    np.testing.assert_allclose(back, twist, atol=1e-10 * (1.0 + reach))
    np.testing.assert_allclose(back, gtsam.Pose3.Logmap(gtsam.Pose3.Expmap(twist)), atol=1e-9 * (1.0 + reach))
    ours = se3.inverse_right_jacobian(twist[None])[0]
    np.testing.assert_allclose(ours, gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Expmap(twist)), atol=1e-7 * (1 + reach))
    # J_r^{-1} J_r = I with J_r by central differences of the exponential.
    step, one = 1e-6, np.eye(4)[None]
    ends = [se3.inverse(se3.se3_exp(twist)) @ se3.se3_exp(twist + s * step * np.eye(6)) for s in (1.0, -1.0)]
    right = (se3.relative_twist(one, ends[0]) - se3.relative_twist(one, ends[1])) / (2 * step)
    np.testing.assert_allclose(ours @ right.T, np.eye(6), atol=1e-6 * (1.0 + reach) ** 2)


def test_relative_twist_is_exact_almost_up_to_a_half_turn(rng: np.random.Generator) -> None:
    axis = rng.normal(size=(6, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    start = se3.se3_exp(rng.normal(size=(6, 6)))
    for missing in (1e-2, 1e-4):
        twist = np.concatenate([(np.pi - missing) * axis, rng.normal(size=(6, 3))], axis=1)
        np.testing.assert_allclose(se3.relative_twist(start, se3.retract(start, twist)), twist, atol=1e-11 / missing)
