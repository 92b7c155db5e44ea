"""Normals of planes and spheres, whose truth is known."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.normals import cloud_normals, normal_colors, normal_map

CAMERA = np.array([200.0, 210.0, 79.5, 59.5])
SIZE = (120, 160)


def rays() -> np.ndarray:
    u, v = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
    return np.stack(((u - CAMERA[2]) / CAMERA[0], (v - CAMERA[3]) / CAMERA[1], np.ones(SIZE)), axis=-1)


def plane(normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth of the plane n . X = -distance, whose unit normal faces the camera."""
    return (-distance / (rays() @ normal)).astype(np.float32)


def angle(normals: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((normals * truth).sum(axis=-1), -1.0, 1.0)))


def test_planes_have_one_exact_normal() -> None:
    for normal in ([0.0, 0.0, -1.0], [0.5, -0.3, -0.8], [-0.2, -0.7, -0.6]):
        unit = np.array(normal) / np.linalg.norm(normal)
        found = normal_map(plane(unit, 2.0), CAMERA)
        assert np.isfinite(found).all()
        assert angle(found, unit).max() < 0.1


def test_a_sphere_is_round() -> None:
    ray = rays()
    center, radius = np.array([0.0, 0.0, 3.0]), 0.6
    b = ray @ center / (ray**2).sum(axis=-1)
    inside = b**2 - (center @ center - radius**2) / (ray**2).sum(axis=-1)
    depth = np.where(inside > 0, b - np.sqrt(np.maximum(inside, 0)), np.nan).astype(np.float32)
    truth = (ray * depth[..., None] - center) / radius
    found = normal_map(depth, CAMERA)
    middle = -truth[..., 2] > 0.6
    assert np.isnan(found[np.isnan(depth)]).all()
    assert angle(found[middle], truth[middle]).max() < 5.0


def test_noise_of_the_depth_is_averaged() -> None:
    unit = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])
    noisy = plane(unit, 2.0) * np.random.default_rng(0).normal(1.0, 0.002, SIZE).astype(np.float32)
    found = normal_map(np.repeat(np.repeat(noisy, 4, axis=0), 4, axis=1), np.array([800.0, 840.0, 319.5, 239.5]))
    coarse = normal_map(noisy, CAMERA)
    assert np.nanmedian(angle(found, unit)) < 15.0
    assert np.nanmedian(angle(coarse, unit)) < 20.0


def test_two_surfaces_are_not_mixed() -> None:
    near, far = np.array([0.0, 0.0, -1.0]), np.array([0.6, 0.0, -0.8])
    depth = plane(far, 4.0)
    depth[:, :80] = plane(near, 1.0)[:, :80]
    found = normal_map(depth, CAMERA)
    for side, normal in ((slice(0, 78), near), (slice(82, 160), far)):
        assert angle(found[:, side], normal).max() < 0.5


def test_points_of_a_cloud_take_the_normals_of_the_frames_that_see_them() -> None:
    unit = np.array([0.5, -0.3, -0.8]) / np.linalg.norm([0.5, -0.3, -0.8])
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    pose[:3, 3] = [1.0, 2.0, 3.0]
    depth = plane(unit, 2.0)
    local = (rays() * depth[..., None])[5:-5:10, 5:-5:10].reshape(-1, 3)
    points = np.concatenate((local, [[0.0, 0.0, 50.0]])) @ pose[:3, :3].T + pose[:3, 3]
    found = cloud_normals(points, [(0, depth)], CAMERA[None], pose[None])
    assert angle(found[:-1], pose[:3, :3] @ unit).max() < 0.1
    np.testing.assert_allclose(found[-1], pose[:3, :3] @ [0.0, 0.0, -1.0], atol=1e-9)


def test_colors_are_halved_and_shifted() -> None:
    normals = np.array([[0.0, 0.0, 1.0], [-1.0, 1.0, 0.0], [np.nan] * 3], np.float32)
    assert normal_colors(normals).tolist() == [[128, 128, 255], [0, 255, 128], [128, 128, 128]]
