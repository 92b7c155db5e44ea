"""Every factor family: analytic Jacobians against torch autograd and central differences, and zero residuals."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from uni4d_fg.factors.arap import ARAP
from uni4d_fg.factors.camera_motion import CAMERA_ROTATION, CAMERA_TRANSLATION
from uni4d_fg.factors.depth_prior import DYNAMIC_DEPTH_PRIOR, STATIC_DEPTH_PRIOR
from uni4d_fg.factors.depth_reprojection import DEPTH_REPROJECTION
from uni4d_fg.factors.dynamic_reprojection import DYNAMIC_REPROJECTION
from uni4d_fg.factors.family import FactorFamily
from uni4d_fg.factors.priors import ASPECT_PRIOR, INTRINSICS_PRIOR, LOG_SCALE_PRIOR, SCALE_ANCHOR
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.factors.temporal_smoothness import ACCELERATION_SMOOTHNESS, VELOCITY_SMOOTHNESS
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.graph.state import TANGENT_DIM

N = 6

FAMILIES = [
    STATIC_REPROJECTION,
    DYNAMIC_REPROJECTION,
    DEPTH_REPROJECTION,
    STATIC_DEPTH_PRIOR,
    DYNAMIC_DEPTH_PRIOR,
    ARAP,
    VELOCITY_SMOOTHNESS,
    ACCELERATION_SMOOTHNESS,
    CAMERA_ROTATION,
    CAMERA_TRANSLATION,
    ASPECT_PRIOR,
    INTRINSICS_PRIOR,
    LOG_SCALE_PRIOR,
    SCALE_ANCHOR,
]
IDS = [f"{f.name}-{len(f.variables)}" for f in FAMILIES]


def random_poses(rng: np.random.Generator, scale: float = 0.3) -> np.ndarray:
    return se3.se3_exp(rng.normal(scale=scale, size=(N, 6)))


def random_variable(group: str, rng: np.random.Generator) -> np.ndarray:
    if group == "pose":
        return random_poses(rng)
    if group == "intrinsics":
        return rng.uniform([450, 450, 300, 200], [600, 600, 340, 260], size=(N, 4))
    if group == "log_scale":
        return rng.normal(scale=0.1, size=(N, 1))
    return rng.uniform([-1, -1, 2], [1, 1, 5], size=(N, 3))


def random_data(name: str, rng: np.random.Generator, family: FactorFamily) -> np.ndarray:
    if name.startswith("uv"):
        return rng.uniform([0, 0], [640, 480], size=(N, 2))
    if name == "world_T_cam":
        return random_poses(rng)
    if name == "intrinsics":
        return random_variable("intrinsics", rng)
    if name == "log_scale":
        return rng.normal(scale=0.1, size=N)
    if name == "floor":
        return np.full(N, 1e-3)
    if name == "measured" and family is ASPECT_PRIOR:
        return rng.normal(scale=0.1, size=N)
    if name == "measured":
        return random_variable(family.variables[0], rng)
    return rng.uniform(1.0, 4.0, size=N)


def random_case(family: FactorFamily, seed: int) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    return [random_variable(g, rng) for g in family.variables], {d: random_data(d, rng, family) for d in family.data}


def retract(group: str, value: np.ndarray, step: np.ndarray) -> np.ndarray:
    return se3.retract(value, step) if group == "pose" else value + step


def numerical_jacobian(family, variables, data, slot, step=1e-6):
    group = family.variables[slot]
    columns = []
    for i in range(TANGENT_DIM[group]):
        out = []
        for sign in (1.0, -1.0):
            d = np.zeros((N, TANGENT_DIM[group]))
            d[:, i] = sign * step
            moved = list(variables)
            moved[slot] = retract(group, variables[slot], d)
            out.append(family.residual(*moved, **data))
        columns.append((out[0] - out[1]) / (2 * step))
    return np.stack(columns, axis=2)


def torch_retract(value: torch.Tensor, xi: torch.Tensor) -> torch.Tensor:
    twist = torch.zeros(N, 4, 4, dtype=torch.float64)
    generators = torch.zeros(6, 4, 4, dtype=torch.float64)
    for i, (a, b) in enumerate([(2, 1), (0, 2), (1, 0)]):
        generators[i, a, b], generators[i, b, a] = 1.0, -1.0
        generators[3 + i, i, 3] = 1.0
    twist = torch.einsum("ni,iab->nab", xi, generators)
    return value @ torch.linalg.matrix_exp(twist)


def autograd_jacobian(family, variables, data, slot):
    group = family.variables[slot]
    tensors = [torch.from_numpy(v) for v in variables]
    torch_data = {k: torch.from_numpy(v) for k, v in data.items()}
    step = torch.zeros(N, TANGENT_DIM[group], dtype=torch.float64, requires_grad=True)
    moved = list(tensors)
    moved[slot] = torch_retract(tensors[slot], step) if group == "pose" else tensors[slot] + step
    r = family.residual(*moved, **torch_data)
    rows = [torch.autograd.grad(r[:, i].sum(), step, retain_graph=True)[0] for i in range(r.shape[1])]
    return torch.stack(rows, dim=1).numpy()


@pytest.mark.parametrize("family", FAMILIES, ids=IDS)
@pytest.mark.parametrize("seed", range(4))
def test_analytic_jacobians_match_autograd_and_central_differences(family: FactorFamily, seed: int) -> None:
    variables, data = random_case(family, seed)
    r, jacobians = family.linearize(*variables, **data)
    np.testing.assert_allclose(r, family.residual(*variables, **data), rtol=1e-12, atol=1e-9)
    assert r.shape == (N, family.residual_dim)
    for slot, jacobian in enumerate(jacobians):
        scale = max(1.0, np.abs(jacobian).max())
        assert jacobian.shape == (N, family.residual_dim, TANGENT_DIM[family.variables[slot]])
        np.testing.assert_allclose(jacobian, autograd_jacobian(family, variables, data, slot), atol=1e-10 * scale)
        np.testing.assert_allclose(jacobian, numerical_jacobian(family, variables, data, slot), atol=2e-6 * scale)


@pytest.mark.parametrize("family", FAMILIES, ids=IDS)
def test_numpy_and_torch_residuals_agree(family: FactorFamily) -> None:
    variables, data = random_case(family, 11)
    ours = family.residual(*variables, **data)
    theirs = family.residual(*map(torch.from_numpy, variables), **{k: torch.from_numpy(v) for k, v in data.items()})
    np.testing.assert_allclose(theirs.numpy(), ours, rtol=1e-12, atol=1e-10)


def test_reprojections_vanish_at_the_truth(rng: np.random.Generator) -> None:
    first, second = random_poses(rng), random_poses(rng)
    intrinsics = random_variable("intrinsics", rng)
    x = random_variable("landmark", rng)
    p = camera_to_world(first, x)
    uv, uv_second = project(intrinsics, x), project(intrinsics, world_to_camera(second, p))
    zero = np.zeros((N, 2))
    np.testing.assert_allclose(STATIC_REPROJECTION.residual(first, p, intrinsics, uv=uv), zero, atol=1e-10)
    np.testing.assert_allclose(
        DYNAMIC_REPROJECTION.residual(p, uv=uv, world_T_cam=first, intrinsics=intrinsics), zero, atol=1e-10
    )
    lifted = {"uv_source": uv, "depth": x[:, 2], "uv_target": uv_second}
    np.testing.assert_allclose(DEPTH_REPROJECTION.residual(first, second, intrinsics, **lifted), zero, atol=1e-9)
    np.testing.assert_allclose(unproject(intrinsics, uv, x[:, 2]), x, atol=1e-12)


def test_depth_prior_vanishes_when_the_scale_explains_the_cue(rng: np.random.Generator) -> None:
    pose, p = random_poses(rng), camera_to_world(random_poses(rng), random_variable("landmark", rng))
    pose[:] = np.eye(4)
    p[:, 2] = np.abs(p[:, 2]) + 0.5
    s = rng.normal(scale=0.1, size=(N, 1))
    cue = p[:, 2] * np.exp(-s[:, 0])
    np.testing.assert_allclose(STATIC_DEPTH_PRIOR.residual(pose, p, s, depth=cue), 0.0, atol=1e-12)
    frozen = {"depth": cue, "world_T_cam": pose, "log_scale": s[:, 0]}
    np.testing.assert_allclose(DYNAMIC_DEPTH_PRIOR.residual(p, **frozen), 0.0, atol=1e-12)


def test_rigid_motion_has_no_arap_energy_and_constant_velocity_no_acceleration(rng: np.random.Generator) -> None:
    p, q = random_variable("landmark", rng), random_variable("landmark", rng)
    motion = random_poses(rng)
    moved = [camera_to_world(motion, v) for v in (p, q)]
    np.testing.assert_allclose(ARAP.residual(p, q, *moved), 0.0, atol=1e-12)
    v = rng.normal(size=(N, 3))
    np.testing.assert_allclose(ACCELERATION_SMOOTHNESS.residual(p, p + v, p + 2 * v), 0.0, atol=1e-12)
    np.testing.assert_allclose(VELOCITY_SMOOTHNESS.residual(p, p), 0.0)


def test_constant_relative_motion_has_no_camera_energy(rng: np.random.Generator) -> None:
    start = random_poses(rng)
    rotation = np.tile(np.eye(4), (N, 1, 1))
    rotation[:, :3, :3] = se3.so3_exp(rng.normal(scale=0.1, size=(N, 3)))
    poses = [start, start @ rotation, start @ rotation @ rotation]
    floor = np.full(N, 1e-3)
    np.testing.assert_allclose(CAMERA_ROTATION.residual(*poses, floor=floor), 0.0, atol=1e-9)
    v = rng.normal(scale=0.1, size=(N, 3))
    for i, pose in enumerate(poses):
        pose[:, :3, 3] = start[:, :3, 3] + i * v
    np.testing.assert_allclose(CAMERA_TRANSLATION.residual(*poses, floor=floor), 0.0, atol=1e-9)


@pytest.mark.parametrize("family", [CAMERA_ROTATION, CAMERA_TRANSLATION], ids=["rotation", "translation"])
def test_camera_at_rest_has_zero_energy_and_finite_jacobians(family: FactorFamily) -> None:
    rest = np.tile(np.eye(4), (N, 1, 1))
    r, jacobians = family.linearize(rest, rest, rest, floor=np.full(N, 1e-3))
    np.testing.assert_array_equal(r, 0.0)
    variables, data = [rest, rest, rest], {"floor": np.full(N, 1e-3)}
    for slot, jacobian in enumerate(jacobians):
        np.testing.assert_allclose(jacobian, autograd_jacobian(family, variables, data, slot), atol=1e-8)
        assert np.abs(jacobian).max() <= 2.0 / 1e-3


def test_arap_at_coinciding_points_has_zero_gradient(rng: np.random.Generator) -> None:
    p, q = random_variable("landmark", rng), random_variable("landmark", rng)
    r, jacobians = ARAP.linearize(p, p, p, q)
    assert np.isfinite(r).all()
    np.testing.assert_array_equal(jacobians[0], 0.0)
    np.testing.assert_allclose(np.linalg.norm(jacobians[3], axis=2), 1.0, atol=1e-6)


@pytest.mark.parametrize("family", [STATIC_REPROJECTION, STATIC_DEPTH_PRIOR], ids=["reprojection", "depth"])
def test_behind_the_camera_the_error_is_large_and_pushes_forward(family: FactorFamily) -> None:
    pose = np.tile(np.eye(4), (N, 1, 1))
    intrinsics = np.tile([500.0, 500.0, 320.0, 240.0], (N, 1))
    z = np.linspace(-2.0, -0.01, N)
    p = np.stack([np.full(N, 0.4), np.full(N, -0.3), z], axis=1)
    variables = [pose, p, intrinsics if family is STATIC_REPROJECTION else np.zeros((N, 1))]
    data = {"uv": np.tile([350.0, 230.0], (N, 1))} if family is STATIC_REPROJECTION else {"depth": np.full(N, 2.0)}
    r, jacobians = family.linearize(*variables, **data)
    for slot, jacobian in enumerate(jacobians):
        scale = max(1.0, np.abs(jacobian).max())
        np.testing.assert_allclose(jacobian, autograd_jacobian(family, variables, data, slot), atol=1e-10 * scale)
    gradient_z = np.einsum("nd,nd->n", r, jacobians[1][:, :, 2])
    assert (gradient_z < 0).all(), "moving forward must lower the energy"
    energy = np.sum(r**2, axis=1)
    assert (np.diff(energy) < 0).all(), "farther behind must cost more"


def test_projection_is_continuous_at_the_near_plane() -> None:
    from uni4d_fg.geometry.camera import NEAR_PLANE, inverse_depth, inverse_depth_slope

    z = NEAR_PLANE * np.array([1 - 1e-7, 1 + 1e-7])
    np.testing.assert_allclose(*inverse_depth(z), rtol=1e-6)
    np.testing.assert_allclose(*inverse_depth_slope(z), rtol=1e-6)
