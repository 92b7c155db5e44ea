"""TUM and KITTI trajectory files: round trip and strict reading."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.trajectory_files import continuous_quaternions, read_kitti, read_tum, write_tum
from uni4d_fg.geometry.trajectory import Trajectory


def random_trajectory(seed: int, count: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3)) * 100
    return Trajectory(1.3e9 + np.cumsum(rng.uniform(0.01, 1, count)), poses)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int) -> None:
    path = tmp_path_factory.mktemp("tum") / "trajectory.tum"
    trajectory = random_trajectory(seed, count)
    write_tum(path, trajectory)
    again = read_tum(path)
    np.testing.assert_allclose(again.timestamps, trajectory.timestamps, atol=1e-6)
    np.testing.assert_allclose(again.world_T_cam, trajectory.world_T_cam, atol=1e-9)
    other = file_interface.read_tum_trajectory_file(path) if count > 1 else None
    if other is not None:
        np.testing.assert_allclose(np.array(other.poses_se3), trajectory.world_T_cam, atol=1e-9)


def test_quaternions_do_not_jump() -> None:
    turns = Rotation.from_euler("z", np.linspace(0, 900, 181)[:, None], degrees=True).as_matrix()
    quaternions = continuous_quaternions(turns)
    assert quaternions[0, 3] > 0
    assert np.abs(np.diff(quaternions, axis=0)).max() < 0.05
    np.testing.assert_allclose(Rotation.from_quat(quaternions).as_matrix(), turns, atol=1e-12)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0 0 0 0 0 1", r"line 3: 7 columns, expected 8: TUM \(timestamp tx ty tz qx qy qz qw\)"),
        ("1 0 0 0 0 0 0 1 5", "line 3: 9 columns"),
        ("1,0,0,0,0,0,0,1", "line 3: 1 columns"),
        ("1 0 0 zero 0 0 0 1", "line 3: could not convert"),
        ("1 0 0 nan 0 0 0 1", "line 3: a value is NaN"),
        ("1 0 0 0 0 0 0 0.5", "line 3: quaternion of length 0.5"),
        ("-1 0 0 0 0 0 0 1", "line 3: timestamp is smaller"),
    ],
)
def test_strict_tum_parser_names_the_line(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(f"# comment\n0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=message):
        read_tum(path)


def test_missing_and_empty_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.tum: no such file"):
        read_tum(tmp_path / "absent.tum")
    (tmp_path / "empty.tum").write_text("# nothing\n\n")
    with pytest.raises(InputError, match="holds no pose"):
        read_tum(tmp_path / "empty.tum")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match="is not text in UTF-8"):
        read_tum(tmp_path / "binary.tum")


def test_kitti_rows_become_poses(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 4 0 1 0 5 0 0 1 6\n0 -1 0 1 1 0 0 2 0 0 1 3\n")
    trajectory = read_kitti(path)
    np.testing.assert_array_equal(trajectory.timestamps, [0.0, 1.0])
    np.testing.assert_array_equal(trajectory.world_T_cam[0, :3, 3], [4, 5, 6])
    np.testing.assert_array_equal(trajectory.world_T_cam[1, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    path.write_text("2 0 0 4 0 1 0 5 0 0 1 6\n")
    with pytest.raises(InputError, match="line 1: not a rotation"):
        read_kitti(path)
    path.write_text("1 0 0 4 0 1 0 5 0 0 1\n")
    with pytest.raises(InputError, match="line 1: 11 columns, expected 12"):
        read_kitti(path)


@pytest.mark.data
def test_real_tum_file_matches_evo(tmp_path: Path) -> None:
    root = os.environ.get("UNI4D_FG_DATA")
    if not root or not (Path(root) / "trajectories").is_dir():
        pytest.skip("set UNI4D_FG_DATA to the folder that holds trajectories/ to run this test")
    path = Path(root) / "trajectories" / "freiburg1_xyz-rgbdslam.txt"
    ours, evo = read_tum(path), file_interface.read_tum_trajectory_file(path)
    np.testing.assert_allclose(ours.world_T_cam, np.array(evo.poses_se3), atol=1e-12)
    write_tum(tmp_path / "again.tum", ours)
    np.testing.assert_allclose(read_tum(tmp_path / "again.tum").world_T_cam, ours.world_T_cam, atol=1e-9)
