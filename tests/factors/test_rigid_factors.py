"""Factors of rigid objects: where they vanish, singular points, and what lies behind the camera."""

from __future__ import annotations

import numpy as np
import pytest
from factor_samples import N, autograd_jacobian, difference_jacobian, random_case, random_values

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors import FactorType
from uni4d_fg.factors.rigid_object import rigid_depth_prior, rigid_reprojection, rigid_smoothness
from uni4d_fg.factors.variable import SE3
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import NEAR_PLANE, camera_to_world, project, world_to_camera


def check_jacobians(kind: FactorType, variables: list[FloatArray], data: dict[str, FloatArray]) -> None:
    r, jacobians = kind.linearize(*variables, **data)
    np.testing.assert_allclose(r, kind.residual(*variables, **data), rtol=1e-12, atol=1e-9)
    for slot, jacobian in enumerate(jacobians):
        scale = max(1.0, np.abs(jacobian).max())
        np.testing.assert_allclose(jacobian, autograd_jacobian(kind, variables, data, slot), atol=1e-9 * scale)
        np.testing.assert_allclose(jacobian, difference_jacobian(kind, variables, data, slot), atol=2e-6 * scale)


def test_data_terms_vanish_at_the_truth_with_exact_jacobians_there() -> None:
    (pose, q), data = random_case(rigid_reprojection, 3)
    x = world_to_camera(data["world_T_cam"], camera_to_world(pose, q))
    data["uv"] = project(data["intrinsics"], x)
    np.testing.assert_allclose(rigid_reprojection.residual(pose, q, **data), 0.0, atol=1e-10)
    check_jacobians(rigid_reprojection, [pose, q], data)
    cue = {"depth": x[:, 2] * np.exp(-0.1), "world_T_cam": data["world_T_cam"], "log_scale": np.full(N, 0.1)}
    np.testing.assert_allclose(rigid_depth_prior.residual(pose, q, **cue), 0.0, atol=1e-12)
    check_jacobians(rigid_depth_prior, [pose, q], cue)


def test_the_choice_of_the_object_frame_does_not_matter(rng: np.random.Generator) -> None:
    (pose, q), data = random_case(rigid_reprojection, 4)
    other = random_values(SE3, rng)
    moved = [pose @ other, world_to_camera(other, q)]
    np.testing.assert_allclose(
        rigid_reprojection.residual(*moved, **data), rigid_reprojection.residual(pose, q, **data), atol=1e-9
    )


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.099, 0.101, 1.0, 3.0])
def test_a_constant_screw_motion_is_smooth_in_any_object_frame(angle: float) -> None:
    rng = np.random.default_rng(6)
    axis = rng.normal(size=(N, 3))
    axis *= angle / np.linalg.norm(axis, axis=1, keepdims=True)
    step = se3.se3_exp(np.concatenate([axis, rng.normal(scale=0.2, size=(N, 3))], axis=1))
    start, other = random_values(SE3, rng), random_values(SE3, rng)
    path = [start, start @ step, start @ step @ step]
    np.testing.assert_allclose(rigid_smoothness.residual(*path), 0.0, atol=1e-12)
    np.testing.assert_allclose(rigid_smoothness.residual(*(p @ other for p in path)), 0.0, atol=1e-12)
    check_jacobians(rigid_smoothness, path, {})


def test_a_half_turn_between_two_frames_stays_finite(rng: np.random.Generator) -> None:
    start, axis = random_values(SE3, rng), rng.normal(size=(N, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turned = se3.retract(start, np.concatenate([np.pi * axis, np.zeros((N, 3))], axis=1))
    r, jacobians = rigid_smoothness.linearize(start, turned, start)
    assert np.isfinite(r).all()
    assert all(np.isfinite(jacobian).all() for jacobian in jacobians)


@pytest.mark.parametrize("kind", [rigid_reprojection, rigid_depth_prior], ids=["reprojection", "depth"])
def test_behind_the_camera_the_error_is_large_and_pushes_forward(kind: FactorType) -> None:
    camera, q = np.tile(np.eye(4), (N, 1, 1)), np.tile([0.4, -0.3, 0.1], (N, 1))
    pose = np.tile(np.eye(4), (N, 1, 1))
    pose[:, 2, 3] = np.linspace(-2.0, NEAR_PLANE - 0.11, N)
    data = {
        "uv": np.tile([350.0, 230.0], (N, 1)),
        "world_T_cam": camera,
        "intrinsics": np.tile([500.0, 500.0, 320.0, 240.0], (N, 1)),
        "depth": np.full(N, 2.0),
        "log_scale": np.zeros(N),
    }
    data = {name: data[name] for name in kind.data}
    check_jacobians(kind, [pose, q], data)
    r, jacobians = kind.linearize(pose, q, **data)
    assert (np.einsum("nd,nd->n", r, jacobians[0][:, :, 5]) < 0).all(), "moving forward must lower the energy"
    assert (np.diff(np.sum(r**2, axis=1)) < 0).all(), "farther behind must cost more"
