"""Static depth of a plane, averaged over noisy views of it."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.geometry import se3
from uni4d_fg.results.fusion.averaging import average_over_frames

K = np.array([160.0, 150.0, 79.5, 59.5])
HEIGHT, WIDTH = 120, 160
NORMAL, DISTANCE = np.array([0.2, -0.1, 1.0]), 3.0


def plane_depth(world_T_cam: np.ndarray, camera: np.ndarray = K) -> np.ndarray:
    """Depth (H, W) of the plane normal . x = distance."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    fx, fy, cx, cy = camera
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) @ world_T_cam[:3, :3].T
    return (DISTANCE - NORMAL @ world_T_cam[:3, 3]) / (rays @ NORMAL)


@pytest.fixture
def poses() -> np.ndarray:
    t = np.arange(9.0) - 4.0
    return se3.se3_exp(np.stack([0.01 * t, -0.012 * t, 0.005 * t, 0.03 * t, 0.02 * t, 0.01 * t], axis=1))


def noisy(depth: np.ndarray, rng: np.random.Generator, sigma: float) -> np.ndarray:
    return (depth * np.exp(sigma * rng.standard_normal(depth.shape))).astype(np.float32)


def error(depth: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.log(depth / truth)[8:-8, 8:-8] ** 2)))


def average(maps: list[np.ndarray], poses: np.ndarray, bound: float = 0.08) -> np.ndarray:
    others = [(maps[i], poses[i], K) for i in range(9) if i != 4]
    return average_over_frames(maps[4], poses[4], others, K, bound).depth


def test_exact_maps_are_left_alone(poses: np.ndarray) -> None:
    maps = [plane_depth(pose).astype(np.float32) for pose in poses]
    assert np.abs(np.log(average(maps, poses) / maps[4])).max() < 1e-4


def test_every_frame_has_its_own_focal_length(poses: np.ndarray) -> None:
    narrow = K * np.array([1.5, 1.5, 1.0, 1.0])
    maps = [plane_depth(pose).astype(np.float32) for pose in poses]
    zoomed = [plane_depth(pose, narrow).astype(np.float32) for pose in poses]
    others = [(zoomed[i], poses[i], narrow) for i in range(9) if i != 4]
    result = average_over_frames(maps[4], poses[4], others, K, 0.08).depth
    assert np.abs(np.log(result / maps[4])).max() < 1e-4
    assert np.abs(np.log(average(zoomed, poses) / zoomed[4])).max() > 1e-3  # with the other's it would not be


def test_noise_shrinks_with_the_number_of_frames(poses: np.ndarray, rng: np.random.Generator) -> None:
    truth = plane_depth(poses[4])
    maps = [noisy(plane_depth(pose), rng, 0.01) for pose in poses]
    # The mean of 9 leaves a third; interpolation between pixels of the others averages further.
    assert error(average(maps, poses), truth) < 0.36 * error(maps[4], truth)


def test_an_occluder_and_what_is_missing_in_another_frame_do_not_count(
    poses: np.ndarray, rng: np.random.Generator
) -> None:
    truth = plane_depth(poses[4])
    maps = [noisy(plane_depth(pose), rng, 0.01) for pose in poses]
    maps[2][:, :80] *= 0.5
    maps[6][30:90] = np.nan
    assert error(average(maps, poses), truth) < 0.40 * error(maps[4], truth)


def test_what_is_missing_stays_missing(poses: np.ndarray) -> None:
    maps = [plane_depth(pose).astype(np.float32) for pose in poses]
    maps[4][20:30, 40:60] = np.nan
    np.testing.assert_array_equal(np.isnan(average(maps, poses)), np.isnan(maps[4]))


def test_a_frame_that_looks_the_other_way_changes_nothing(poses: np.ndarray, rng: np.random.Generator) -> None:
    depth = noisy(plane_depth(poses[4]), rng, 0.01)
    away = poses[4] @ np.diag([-1.0, 1.0, -1.0, 1.0])
    averaged = average_over_frames(depth, poses[4], [(depth, away, K)], K, 10.0)
    np.testing.assert_array_equal(averaged.depth, depth)
    assert averaged.seeing.max() == 0


def test_it_counts_who_sees_and_who_agrees(poses: np.ndarray) -> None:
    maps = [plane_depth(pose).astype(np.float32) for pose in poses]
    maps[2][:] *= 0.5
    averaged = average_over_frames(maps[4], poses[4], [(maps[i], poses[i], K) for i in (2, 3, 5)], K, 0.05)
    inner = (slice(30, 90), slice(40, 120))
    assert averaged.seeing[inner].min() == 3
    assert averaged.agreeing[inner].max() == averaged.agreeing[inner].min() == 2
