"""Every declared factor type: analytic Jacobians against torch autograd and central differences, and zero residuals."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
import torch
from factor_samples import (
    N,
    autograd_jacobian,
    declared,
    difference_jacobian,
    random_case,
    random_values,
    random_variable,
)

import uni4d_fg
from uni4d_fg.errors import SolverError
from uni4d_fg.factors import FactorType, factor, factor_type, factor_types
from uni4d_fg.factors import batch as batch_module
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.camera_motion import camera_rotation, camera_translation, relative_camera_translation
from uni4d_fg.factors.depth_prior import dynamic_depth_prior, static_depth_prior
from uni4d_fg.factors.depth_reprojection import depth_reprojection
from uni4d_fg.factors.dynamic_reprojection import dynamic_reprojection
from uni4d_fg.factors.state import State
from uni4d_fg.factors.static_reprojection import static_reprojection
from uni4d_fg.factors.temporal_smoothness import acceleration_smoothness, velocity_smoothness
from uni4d_fg.factors.variable import SE3
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera

TYPES = declared()
every_type = pytest.mark.parametrize("kind", TYPES, ids=[kind.name for kind in TYPES])


def random_poses(rng: np.random.Generator) -> np.ndarray:
    return random_values(SE3, rng)


def test_every_declaration_of_the_package_is_listed() -> None:
    names = set()
    for path in Path(uni4d_fg.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                calls = [d for d in node.decorator_list if isinstance(d, ast.Call) and isinstance(d.func, ast.Name)]
                names |= {node.name for call in calls if call.func.id == "factor"}
    assert {kind.residual.__name__ for kind in TYPES} == names
    assert len(names) >= 14


@every_type
@pytest.mark.parametrize("seed", range(4))
def test_jacobians_match_autograd_and_central_differences(kind: FactorType, seed: int) -> None:
    variables, data = random_case(kind, seed)
    r, jacobians = kind.linearize(*variables, **data)
    np.testing.assert_allclose(r, kind.residual(*variables, **data), rtol=1e-12, atol=1e-9)
    assert r.shape == (N, kind.dim)
    assert len(jacobians) == len(kind.variables)
    exact = 1e-10 if kind.is_analytic else 1e-7
    for slot, (variable, jacobian) in enumerate(zip(kind.variables, jacobians, strict=True)):
        scale = max(1.0, np.abs(jacobian).max())
        assert jacobian.shape == (N, kind.dim, variable.dim)
        np.testing.assert_allclose(jacobian, autograd_jacobian(kind, variables, data, slot), atol=exact * scale)
        np.testing.assert_allclose(jacobian, difference_jacobian(kind, variables, data, slot), atol=2e-6 * scale)


@every_type
@pytest.mark.parametrize("seed", range(4))
def test_without_an_analytic_jacobian_there_are_differences(kind: FactorType, seed: int) -> None:
    """The error is 1e-7 of the largest entry: rounding of the residual over a step of 1e-6."""
    plain = FactorType("plain", kind.variables, kind.data, kind.dim, kind.residual, listed=False)
    assert not plain.is_analytic
    variables, data = random_case(kind, seed)
    r, jacobians = plain.linearize(*variables, **data)
    np.testing.assert_array_equal(r, kind.residual(*variables, **data))
    for slot, jacobian in enumerate(jacobians):
        exact = autograd_jacobian(kind, variables, data, slot)
        size = max(1.0, np.abs(exact).max())
        np.testing.assert_allclose(jacobian, exact, rtol=0.0, atol=1e-7 * size)


@every_type
def test_numpy_and_torch_residuals_agree(kind: FactorType) -> None:
    variables, data = random_case(kind, 11)
    ours = kind.residual(*variables, **data)
    theirs = kind.residual(*map(torch.from_numpy, variables), **{k: torch.from_numpy(v) for k, v in data.items()})
    np.testing.assert_allclose(theirs.numpy(), ours, rtol=1e-12, atol=1e-10)


def test_a_declaration_is_a_few_lines(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    monkeypatch.setattr(factor_type, "_LISTED", dict(factor_type._LISTED))

    @factor(POSE, data={"xyz": 3}, dim=3)
    def position_prior(world_T_cam, *, xyz):
        return world_T_cam[..., :3, 3] - xyz

    assert factor_types()[-1] is position_prior
    assert not position_prior.is_analytic
    poses, xyz = random_poses(rng), rng.normal(size=(N, 3))
    r, (jacobian,) = position_prior.linearize(poses, xyz=xyz)
    np.testing.assert_allclose(r, poses[:, :3, 3] - xyz)
    # d c / d v = R for a twist (omega, v) of the body.
    np.testing.assert_allclose(jacobian, np.concatenate([np.zeros((N, 3, 3)), poses[:, :3, :3]], axis=2), atol=1e-9)
    batch = position_prior(np.arange(N), xyz=xyz, sigma=0.05, term="marker")
    assert (len(batch), batch.name, batch.factor_type) == (N, "marker", position_prior)

    @position_prior.jacobian
    def analytic(world_T_cam, *, xyz):
        return position_prior.residual(world_T_cam, xyz=xyz), [jacobian]

    assert position_prior.is_analytic
    assert position_prior.linearize(poses, xyz=xyz)[1][0] is jacobian


def test_names_of_types_and_data_are_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factor_type, "_LISTED", dict(factor_type._LISTED))

    def residual(landmark, **data):
        return landmark

    with pytest.raises(SolverError, match=r"'arap' is declared in uni4d_fg\.factors\.arap already"):
        factor(LANDMARK, dim=3, name="arap")(residual)
    with pytest.raises(SolverError, match="'mine': data may not be called sigma, weight"):
        factor(LANDMARK, data={"weight": (), "sigma": (), "uv": 2}, dim=3, name="mine")(residual)
    first, again = (factor(LANDMARK, dim=3, name="mine")(residual) for _ in range(2))
    assert first is not again
    assert [kind for kind in factor_types() if kind.name == "mine"] == [again]


def test_reprojections_vanish_at_the_truth(rng: np.random.Generator) -> None:
    first, second = random_poses(rng), random_poses(rng)
    intrinsics = random_variable(INTRINSICS, rng)
    x = random_variable(LANDMARK, rng)
    p = camera_to_world(first, x)
    uv, uv_second = project(intrinsics, x), project(intrinsics, world_to_camera(second, p))
    zero = np.zeros((N, 2))
    np.testing.assert_allclose(static_reprojection.residual(first, p, intrinsics, uv=uv), zero, atol=1e-10)
    np.testing.assert_allclose(
        dynamic_reprojection.residual(p, uv=uv, world_T_cam=first, intrinsics=intrinsics), zero, atol=1e-10
    )
    lifted = {"uv_source": uv, "depth": x[:, 2], "uv_target": uv_second}
    np.testing.assert_allclose(depth_reprojection.residual(first, second, intrinsics, **lifted), zero, atol=1e-9)
    np.testing.assert_allclose(unproject(intrinsics, uv, x[:, 2]), x, atol=1e-12)


def test_depth_prior_vanishes_when_the_scale_explains_the_cue(rng: np.random.Generator) -> None:
    pose, p = random_poses(rng), camera_to_world(random_poses(rng), random_variable(LANDMARK, rng))
    pose[:] = np.eye(4)
    p[:, 2] = np.abs(p[:, 2]) + 0.5
    s = rng.normal(scale=0.1, size=(N, 1))
    cue = p[:, 2] * np.exp(-s[:, 0])
    np.testing.assert_allclose(static_depth_prior.residual(pose, p, s, depth=cue), 0.0, atol=1e-12)
    frozen = {"depth": cue, "world_T_cam": pose, "log_scale": s[:, 0]}
    np.testing.assert_allclose(dynamic_depth_prior.residual(p, **frozen), 0.0, atol=1e-12)


def test_rigid_motion_has_no_arap_energy_and_constant_velocity_no_acceleration(rng: np.random.Generator) -> None:
    p, q = random_variable(LANDMARK, rng), random_variable(LANDMARK, rng)
    motion = random_poses(rng)
    moved = [camera_to_world(motion, v) for v in (p, q)]
    np.testing.assert_allclose(arap.residual(p, q, *moved), 0.0, atol=1e-12)
    v = rng.normal(size=(N, 3))
    np.testing.assert_allclose(acceleration_smoothness.residual(p, p + v, p + 2 * v), 0.0, atol=1e-12)
    np.testing.assert_allclose(velocity_smoothness.residual(p, p), 0.0)


def test_constant_relative_motion_has_no_camera_energy(rng: np.random.Generator) -> None:
    start = random_poses(rng)
    rotation = np.tile(np.eye(4), (N, 1, 1))
    rotation[:, :3, :3] = se3.so3_exp(rng.normal(scale=0.1, size=(N, 3)))
    poses = [start, start @ rotation, start @ rotation @ rotation]
    floor = np.full(N, 1e-3)
    np.testing.assert_allclose(camera_rotation.residual(*poses, floor=floor), 0.0, atol=1e-9)
    rotation[:, :3, 3] = rng.normal(scale=0.1, size=(N, 3))
    circling = [start, start @ rotation, start @ rotation @ rotation]
    np.testing.assert_allclose(relative_camera_translation.residual(*circling, floor=floor), 0.0, atol=1e-9)
    v = rng.normal(scale=0.1, size=(N, 3))
    for i, pose in enumerate(poses):
        pose[:, :3, 3] = start[:, :3, 3] + i * v
    np.testing.assert_allclose(camera_translation.residual(*poses, floor=floor), 0.0, atol=1e-9)


def test_axes_do_not_matter_where_the_camera_does_not_turn(rng: np.random.Generator) -> None:
    """The residuals are the same vector in other axes; where the camera turns, the two energies are not the same."""
    rotation = random_poses(rng)[:, :3, :3]
    poses, floor = [random_poses(rng) for _ in range(3)], np.full(N, 1e-3)
    sizes = [
        np.linalg.norm(kind.residual(*poses, floor=floor), axis=1)
        for kind in (camera_translation, relative_camera_translation)
    ]
    assert np.abs(sizes[0] - sizes[1]).max() > 0.02
    for pose in poses:
        pose[:, :3, :3] = rotation
    world = camera_translation.residual(*poses, floor=floor)
    camera = relative_camera_translation.residual(*poses, floor=floor)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", rotation, camera), world, atol=1e-12)


def test_the_relative_translation_is_that_of_the_relative_pose_of_the_paper(rng: np.random.Generator) -> None:
    before, now, after = (random_poses(rng) for _ in range(3))
    first, second = (np.linalg.inv(b) @ a for a, b in ((before, now), (now, after)))
    sizes = [np.sqrt(np.sum(pose[:, :3, 3] ** 2, axis=1) + 1e-6) for pose in (first, second)]
    expected = 2.0 * (second - first)[:, :3, 3] / (sizes[0] + sizes[1])[:, None]
    found = relative_camera_translation.residual(before, now, after, floor=np.full(N, 1e-3))
    np.testing.assert_allclose(found, expected, atol=1e-12)


MOTIONS = [camera_rotation, camera_translation, relative_camera_translation]


@pytest.mark.parametrize("kind", MOTIONS, ids=[kind.name for kind in MOTIONS])
def test_camera_at_rest_has_zero_energy_and_finite_jacobians(kind: FactorType) -> None:
    rest = np.tile(np.eye(4), (N, 1, 1))
    r, jacobians = kind.linearize(rest, rest, rest, floor=np.full(N, 1e-3))
    np.testing.assert_array_equal(r, 0.0)
    variables, data = [rest, rest, rest], {"floor": np.full(N, 1e-3)}
    for slot, jacobian in enumerate(jacobians):
        np.testing.assert_allclose(jacobian, autograd_jacobian(kind, variables, data, slot), atol=1e-8)
        assert np.abs(jacobian).max() <= 2.0 / 1e-3


def test_arap_at_coinciding_points_has_zero_gradient(rng: np.random.Generator) -> None:
    p, q = random_variable(LANDMARK, rng), random_variable(LANDMARK, rng)
    r, jacobians = arap.linearize(p, p, p, q)
    assert np.isfinite(r).all()
    np.testing.assert_array_equal(jacobians[0], 0.0)
    np.testing.assert_allclose(np.linalg.norm(jacobians[3], axis=2), 1.0, atol=1e-6)


@pytest.mark.parametrize("kind", [static_reprojection, static_depth_prior], ids=["reprojection", "depth"])
def test_behind_the_camera_the_error_is_large_and_pushes_forward(kind: FactorType) -> None:
    pose = np.tile(np.eye(4), (N, 1, 1))
    intrinsics = np.tile([500.0, 500.0, 320.0, 240.0], (N, 1))
    z = np.linspace(-2.0, -0.01, N)
    p = np.stack([np.full(N, 0.4), np.full(N, -0.3), z], axis=1)
    variables = [pose, p, intrinsics if kind is static_reprojection else np.zeros((N, 1))]
    data = {"uv": np.tile([350.0, 230.0], (N, 1))} if kind is static_reprojection else {"depth": np.full(N, 2.0)}
    r, jacobians = kind.linearize(*variables, **data)
    for slot, jacobian in enumerate(jacobians):
        scale = max(1.0, np.abs(jacobian).max())
        np.testing.assert_allclose(jacobian, autograd_jacobian(kind, variables, data, slot), atol=1e-10 * scale)
    gradient_z = np.einsum("nd,nd->n", r, jacobians[1][:, :, 2])
    assert (gradient_z < 0).all(), "moving forward must lower the energy"
    energy = np.sum(r**2, axis=1)
    assert (np.diff(energy) < 0).all(), "farther behind must cost more"


def test_projection_is_continuous_at_the_near_plane() -> None:
    from uni4d_fg.geometry.camera import NEAR_PLANE, inverse_depth, inverse_depth_slope

    z = NEAR_PLANE * np.array([1 - 1e-7, 1 + 1e-7])
    np.testing.assert_allclose(*inverse_depth(z), rtol=1e-6)
    np.testing.assert_allclose(*inverse_depth_slope(z), rtol=1e-6)


@every_type
def test_squared_norms_in_parts_are_those_at_once(kind: FactorType, monkeypatch: pytest.MonkeyPatch) -> None:
    variables, data = random_case(kind, seed=4)
    rows = np.arange(N)[::-1]
    state = State({v: np.concatenate([variables[i] for i, w in enumerate(kind.variables) if w is v])
                   for v in dict.fromkeys(kind.variables)})  # fmt: skip
    slots = [rows + N * kind.variables[:i].count(v) for i, v in enumerate(kind.variables)]
    batch = kind(*slots, **data, sigma=np.linspace(0.5, 2.0, N), weight=np.linspace(0.1, 1.0, N))
    at_once, energy = batch.squared_norm(state), batch.energy(state)
    monkeypatch.setattr(batch_module, "_PART_ROWS", 4)
    np.testing.assert_allclose(batch.squared_norm(state), at_once, rtol=1e-13, atol=1e-300)
    assert batch.energy(state) == pytest.approx(energy, rel=1e-13)
