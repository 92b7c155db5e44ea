"""ATE and RPE equal evo's numbers, on random trajectories and on real files."""

from __future__ import annotations

import copy
import os
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.trajectory_files import read_kitti, read_tum
from uni4d_fg.geometry.trajectory import Trajectory, associate
from uni4d_fg.results.evaluate.trajectory import evaluate_trajectory, path_length


def evo_numbers(reference: PoseTrajectory3D, estimate: PoseTrajectory3D, scale: bool) -> np.ndarray:
    estimate = copy.deepcopy(estimate)
    _, _, found_scale = estimate.align(reference, correct_scale=scale)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    numbers = [ape.get_statistic(metrics.StatisticsType.rmse)]
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
        rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((reference, estimate))
        numbers.append(rpe.get_statistic(metrics.StatisticsType.rmse))
    return np.array([*numbers, found_scale])


def our_numbers(estimate: np.ndarray, reference: np.ndarray, scale: bool) -> np.ndarray:
    found = evaluate_trajectory(estimate, reference, alignment="sim3" if scale else "se3")
    return np.array([found.ate_m, found.rpe_translation_m, found.rpe_rotation_deg, found.scale], dtype=float)


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    out[:, :3, 3] = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    return out


def evo_trajectory(timestamps: np.ndarray, poses: np.ndarray) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(poses.copy()), timestamps=timestamps)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40), st.booleans())
def test_equals_evo_on_random_trajectories(seed: int, count: int, scale: bool) -> None:
    rng = np.random.default_rng(seed)
    reference, estimate = random_poses(rng, count), random_poses(rng, count)
    times = np.arange(count, dtype=float)
    expected = evo_numbers(evo_trajectory(times, reference), evo_trajectory(times, estimate), scale)
    np.testing.assert_allclose(our_numbers(estimate, reference, scale), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("swap", [False, True])
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(1, 30), st.floats(0.001, 0.2))
def test_association_equals_evo(swap: bool, seed: int, count_a: int, count_b: int, tolerance: float) -> None:
    rng = np.random.default_rng(seed)
    a = Trajectory(np.sort(rng.uniform(0, 2, count_a)), random_poses(rng, count_a))
    b = Trajectory(np.sort(rng.uniform(0, 2, count_b)), random_poses(rng, count_b))
    if swap:
        a, b = b, a
    try:
        reference, estimate = sync.associate_trajectories(
            evo_trajectory(b.timestamps, b.world_T_cam), evo_trajectory(a.timestamps, a.world_T_cam), max_diff=tolerance
        )
    except sync.SyncException:
        with pytest.raises(InputError, match="no two poses"):
            associate(a, b, tolerance_s=tolerance)
        return
    ours_estimate, ours_reference = associate(a, b, tolerance_s=tolerance)
    np.testing.assert_array_equal(ours_estimate.timestamps, estimate.timestamps)
    np.testing.assert_array_equal(ours_reference.timestamps, reference.timestamps)


def trajectory_folder() -> Path:
    root = os.environ.get("UNI4D_FG_DATA")
    if not root or not (Path(root) / "trajectories").is_dir():
        pytest.skip("set UNI4D_FG_DATA to the folder that holds trajectories/ to run this test")
    return Path(root) / "trajectories"


@pytest.mark.data
@pytest.mark.parametrize("name", ["rgbdslam", "rgbdslam_drift"])
@pytest.mark.parametrize("tolerance", [0.01, 0.002])
@pytest.mark.parametrize("scale", [True, False])
def test_equals_evo_on_tum_files(name: str, tolerance: float, scale: bool) -> None:
    folder = trajectory_folder()
    reference_path, estimate_path = folder / "freiburg1_xyz-groundtruth.txt", folder / f"freiburg1_xyz-{name}.txt"
    reference, estimate = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(reference_path),
        file_interface.read_tum_trajectory_file(estimate_path),
        max_diff=tolerance,
    )
    ours_estimate, ours_reference = associate(read_tum(estimate_path), read_tum(reference_path), tolerance_s=tolerance)
    assert len(ours_estimate) == estimate.num_poses
    expected = evo_numbers(reference, estimate, scale)
    ours = our_numbers(ours_estimate.world_T_cam, ours_reference.world_T_cam, scale)
    np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-9)
    assert path_length(ours_reference.world_T_cam) == pytest.approx(reference.path_length, abs=1e-9)


@pytest.mark.data
def test_equals_evo_on_kitti_files() -> None:
    folder = trajectory_folder()
    paths = folder / "KITTI_00_ORB.txt", folder / "KITTI_00_gt.txt"
    estimate, reference = (read_kitti(path) for path in paths)
    evo_estimate, evo_reference = (file_interface.read_kitti_poses_file(path) for path in paths)
    expected = evo_numbers(evo_reference, evo_estimate, True)
    ours = our_numbers(estimate.world_T_cam, reference.world_T_cam, True)
    np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-9)
    assert len(estimate) == 4541


def test_a_similar_estimate_scores_zero_and_names_its_scale() -> None:
    rng = np.random.default_rng(0)
    reference = random_poses(rng, 12)
    estimate = reference.copy()
    estimate[:, :3, 3] /= 2.5
    found = evaluate_trajectory(estimate, reference)
    assert found.protocol == "Sim(3) Umeyama, RMSE, RPE delta 1 frame, all pairs"
    assert found.scale == pytest.approx(2.5)
    assert found.ate_m == pytest.approx(0.0, abs=1e-9)
    assert found.rpe_translation_m == pytest.approx(0.0, abs=1e-9)
    assert found.rpe_rotation_deg == pytest.approx(0.0, abs=1e-6)
    assert found.path_length_reference_m == pytest.approx(2.5 * found.path_length_estimate_m)
    assert found.to_dict()["poses"] == 12


def test_without_alignment_an_offset_is_the_error() -> None:
    poses = random_poses(np.random.default_rng(1), 5)
    shifted = poses.copy()
    shifted[:, :3, 3] += [3.0, 4.0, 0.0]
    found = evaluate_trajectory(shifted, poses, alignment="none", delta=2)
    assert found.ate_m == pytest.approx(5.0)
    assert found.rpe_translation_m == pytest.approx(0.0, abs=1e-9)
    assert found.protocol == "no alignment, RMSE, RPE delta 2 frames, all pairs"


def test_one_pose_has_no_relative_error() -> None:
    found = evaluate_trajectory(np.eye(4)[None], np.eye(4)[None])
    assert found.rpe_translation_m is None
    assert found.rpe_rotation_deg is None
    assert found.degenerate == "motionless_estimate"


def test_camera_at_rest_is_scored_not_refused() -> None:
    estimate = np.tile(np.eye(4), (6, 1, 1))
    reference = random_poses(np.random.default_rng(2), 6)
    found = evaluate_trajectory(estimate, reference)
    spread = reference[:, :3, 3] - reference[:, :3, 3].mean(axis=0)
    assert found.degenerate == "motionless_estimate"
    assert found.ate_m == pytest.approx(np.sqrt((spread**2).sum(axis=1).mean()))


def test_poses_that_are_not_finite_are_refused() -> None:
    poses = random_poses(np.random.default_rng(3), 4)
    bad = poses.copy()
    bad[2, 0, 3] = np.nan
    with pytest.raises(InputError, match="pose 2 of the estimate"):
        evaluate_trajectory(bad, poses)
    with pytest.raises(InputError, match="pose 2"):
        Trajectory(np.arange(4.0), bad)
    with pytest.raises(InputError, match="must both be"):
        evaluate_trajectory(poses[:3], poses)
    with pytest.raises(InputError, match=r"T > 0"):
        Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
