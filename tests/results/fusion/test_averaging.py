"""Static depth of a plane, averaged over noisy views of it."""

from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.geometry import se3
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.averaging import (
    Averaged,
    average_over_frames,
    chosen_by_others,
    compare_frames_numpy,
)

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
    others = [(1 / maps[i], poses[i], K) for i in range(9) if i != 4]
    return np.exp(average_over_frames(1 / maps[4], poses[4], others, K, bound).log_depth)


def test_exact_maps_are_left_alone(poses: np.ndarray) -> None:
    maps = [plane_depth(pose).astype(np.float32) for pose in poses]
    assert np.abs(np.log(average(maps, poses) / maps[4])).max() < 1e-4


def test_every_frame_has_its_own_focal_length(poses: np.ndarray) -> None:
    narrow = K * np.array([1.5, 1.5, 1.0, 1.0])
    maps = [plane_depth(pose).astype(np.float32) for pose in poses]
    zoomed = [plane_depth(pose, narrow).astype(np.float32) for pose in poses]
    others = [(1 / zoomed[i], poses[i], narrow) for i in range(9) if i != 4]
    result = np.exp(average_over_frames(1 / maps[4], poses[4], others, K, 0.08).log_depth)
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
    averaged = average_over_frames(1 / depth, poses[4], [(1 / depth, away, K)], K, 10.0)
    np.testing.assert_array_equal(averaged.log_depth, -np.log(1 / depth))
    assert averaged.seeing.max() == 0


def test_it_counts_who_sees_and_who_agrees(poses: np.ndarray) -> None:
    maps = [plane_depth(pose).astype(np.float32) for pose in poses]
    maps[2][:] *= 0.5
    averaged = average_over_frames(1 / maps[4], poses[4], [(1 / maps[i], poses[i], K) for i in (2, 3, 5)], K, 0.05)
    inner = (slice(30, 90), slice(40, 120))
    assert averaged.seeing[inner].min() == 3
    assert averaged.agreeing[inner].max() == averaged.agreeing[inner].min() == 2


def test_cpp_and_numpy_agree(rng: np.random.Generator) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    own = (0.3 * np.exp(0.1 * rng.standard_normal((37, 53)))).astype(np.float32)
    own[3:6, 10:20] = np.nan
    others = [
        (0.3 * np.exp(0.1 * rng.standard_normal(size))).astype(np.float32) for size in ((37, 53), (20, 60), (1, 1))
    ]
    others[0][20:23] = np.nan
    others[1][5:9, 5:9] = -1.0
    turns = np.eye(3) + 0.01 * rng.standard_normal((3, 3, 3)) * np.array([1.0, 1.0, 30.0]) / np.array(
        [[1.0], [1.0], [30.0]]
    )
    turns[2] *= 1e-3
    shifts = rng.standard_normal((3, 3)) * np.array([20.0, 20.0, 0.3])
    slow = compare_frames_numpy(own, others, turns, shifts, 1.2, 1.05)
    for threads in (1, 3):
        fast = core.compare_frames(own, others, turns, shifts, agree=1.2, alike=1.05, threads=threads)
        # Fused multiplication and addition round otherwise: a ratio beside a bound may fall on its other side.
        same = (fast[1:] == slow[1:]).all(axis=0)
        assert same.mean() > 0.999
        np.testing.assert_allclose(fast[0][same], slow[0][same], rtol=1e-3)
    assert slow[1].max() >= 1
    assert (slow[2] > slow[1]).any()
    assert (slow[3] < slow[1]).any()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"inverse_depth": np.ones((3, 4))}, "inverse_depth: expected float32"),
        ({"others": [np.ones(4, np.float32)]}, "others: expected float32"),
        ({"others": [np.ones((0, 4), np.float32)]}, "others: a map is empty"),
        ({"others": []}, "turns: expected"),
        ({"agree": 0.9}, "agree, alike"),
        ({"alike": float("nan")}, "agree, alike"),
    ],
)
def test_bad_input_is_named(wrong: dict[str, object], message: str) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    given = {
        "inverse_depth": np.ones((3, 4), np.float32), "others": [np.ones((3, 4), np.float32)],
        "turns": np.eye(3)[None], "shifts": np.zeros((1, 3)), "agree": 1.1, "alike": 1.1,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        core.compare_frames(**(given | wrong))


def test_carried_depth_counts_where_two_more_frames_show_the_same() -> None:
    zero, many = np.zeros((1, 4), np.float32), np.full((1, 4), 8, np.float32)
    own = Averaged(zero, zero, many, np.array([[2, 2, 2, 0]], np.float32))
    carried = Averaged(zero + 1, zero, many, np.array([[2, 3, 4, 1]], np.float32))
    chosen = chosen_by_others(own, carried)
    assert chosen.log_depth.tolist() == [[0, 0, 1, 0]]
    assert chosen.alike.tolist() == [[2, 2, 4, 0]]
