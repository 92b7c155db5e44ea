"""Projective maps of space: what cameras see stays, and focal lengths follow the distance to the plane."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.geometry.plane_at_infinity import PlaneAtInfinity
from uni4d_fg.geometry.se3 import so3_exp

K = np.array([300.0, 300.0, 160.0, 120.0])


def along_the_view(rng: np.random.Generator, beside: float = 0.0, turned: float = 0.0) -> np.ndarray:
    """Cameras (5, 4, 4) on a line along their views, in a world that is turned and shifted."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = so3_exp(rng.normal(0.0, 1.0, (5, 3)) * turned)
    poses[:, :3, 3] = np.stack([*(rng.normal(0.0, 1.0, (2, 5)) * beside), np.linspace(0.0, 1.0, 5)], axis=1)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = so3_exp(rng.normal(0.0, 1.0, 3)), rng.normal(0.0, 3.0, 3)
    return np.asarray(world @ poses)


def seen(poses: np.ndarray, points: np.ndarray, zoom: np.ndarray | float = 1.0) -> np.ndarray:
    """Pixels (T, N, 2) of points before all cameras, whose focal lengths are those of K times a factor (T,)."""
    intrinsics = np.tile(K, (len(poses), 1))
    intrinsics[:, :2] *= np.broadcast_to(zoom, len(poses))[:, None]
    x = np.stack([world_to_camera(pose, points) for pose in poses])
    assert (x[..., 2] > 0.0).all()
    return np.stack([np.asarray(project(one, each)) for one, each in zip(intrinsics, x, strict=True)])


def mapped(plane: PlaneAtInfinity, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) in the world that the map makes, by its definition."""
    moved = (points - plane.origin) / ((points @ plane.normal - plane.offset) / plane.scale)[:, None]
    return moved - 2.0 * np.outer(moved @ plane.normal, plane.normal) if plane.exchanges else moved


def some_points(rng: np.random.Generator, poses: np.ndarray, near: float, far: float) -> np.ndarray:
    """Points (30, 3) in the world, at depths ahead of the last camera."""
    depth = rng.uniform(near, far, 30)
    local = np.stack([rng.uniform(-0.5, 0.5, 30) * depth, rng.uniform(-0.4, 0.4, 30) * depth, depth], axis=1)
    return np.asarray(local @ poses[-1, :3, :3].T + poses[-1, :3, 3])


@given(st.integers(0, 10_000), st.sampled_from([0.5, 0.8, 1.2, 1.25]))
def test_cameras_on_the_axis_see_the_same_with_a_zoom(seed: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    poses = along_the_view(rng)
    points = some_points(rng, poses, 1.0, 3.5)  # at 1.25 the plane is 4 m ahead
    plane = PlaneAtInfinity.across(poses, ratio)
    assert plane is not None
    moved, growth = plane.cameras(poses)
    np.testing.assert_allclose(growth[-1] / growth[0], ratio, rtol=1e-9)
    assert growth[0] == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(seen(moved, mapped(plane, points), growth), seen(poses, points), atol=1e-6)


@given(st.integers(0, 10_000), st.sampled_from([2.0, 3.0]))
def test_points_beyond_the_plane_are_exchanged_and_seen_as_before(seed: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    poses = along_the_view(rng)
    points = some_points(rng, poses, 1.5, 20.0)  # at 2 the plane is 1 m ahead
    plane = PlaneAtInfinity.across(poses, ratio, exchanges=True)
    assert plane is not None
    moved, growth = plane.cameras(poses)
    there = mapped(plane, points)
    np.testing.assert_allclose(np.linalg.det(moved[:, :3, :3]), 1.0, atol=1e-9)
    np.testing.assert_allclose(growth[-1] / growth[0], ratio, rtol=1e-9)
    np.testing.assert_allclose(seen(moved, there, growth), seen(poses, points), atol=1e-6)
    before, after = (world_to_camera(one[0], each)[:, 2] for one, each in ((poses, points), (moved, there)))
    assert np.array_equal(np.argsort(before), np.argsort(after)[::-1])


@pytest.mark.parametrize(("ratio", "exchanges"), [(0.7, False), (1.2, False), (1.5, True)])
def test_beside_the_axis_the_middle_of_the_picture_is_kept(
    rng: np.random.Generator, ratio: float, exchanges: bool
) -> None:
    """What is in the middle stays there; what is a little beside it moves by the square of that, and by what skews."""
    poses = along_the_view(rng, 0.1, 0.1)
    plane = PlaneAtInfinity.across(poses, ratio, exchanges=exchanges)
    assert plane is not None
    moved, growth = plane.cameras(poses)
    np.testing.assert_allclose(np.linalg.det(moved[:, :3, :3]), 1.0, atol=1e-9)
    depth = 6.0 if exchanges else 2.0
    for before, after, zoom in zip(poses, moved, growth, strict=True):
        for away in (0.0, 0.01, 0.02):
            around = away * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
            points = depth * np.column_stack([around, np.ones(4)]) @ before[:3, :3].T + before[:3, 3]
            pixels = seen(after[None], mapped(plane, points), zoom)[0]
            radius = np.linalg.norm(pixels - K[2:], axis=1)
            # The geometric mean of both directions is the focal length; they may differ.
            area = np.sqrt(np.linalg.norm(pixels[0] - pixels[2]) * np.linalg.norm(pixels[1] - pixels[3])) / 2.0
            assert area == pytest.approx(K[0] * away, rel=0.01, abs=1e-6)
            np.testing.assert_allclose(radius, K[0] * away, rtol=0.15, atol=1e-6)


def test_there_is_no_such_plane_without_motion_along_the_view(rng: np.random.Generator) -> None:
    still = np.tile(along_the_view(rng)[0], (4, 1, 1))
    assert PlaneAtInfinity.across(still, 1.5) is None
    assert PlaneAtInfinity.across(along_the_view(rng), 1.0) is None
