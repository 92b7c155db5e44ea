"""Odometry, GPS and relative poses read from files: against GTSAM, against sampling, and what is refused."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uni4d_fg.config.measurements import MeasurementsConfig
from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.frontend.measurements.gps import earth_centered, east_north_up, read_gps
from uni4d_fg.frontend.measurements.odometry import read_odometry
from uni4d_fg.frontend.measurements.relative_poses import read_relative_poses
from uni4d_fg.geometry import se3

CONFIG = MeasurementsConfig()


def path_of_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    steps = se3.se3_exp(rng.normal(scale=[0.1, 0.1, 0.1, 0.3, 0.3, 0.3], size=(count, 6)))
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def write_tum_rows(path: Path, times: np.ndarray, poses: np.ndarray, sigmas: np.ndarray | None = None) -> None:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    columns = [times[:, None], poses[:, :3, 3], quaternions, *([] if sigmas is None else [sigmas])]
    np.savetxt(path, np.concatenate(columns, axis=1), fmt="%.17g")


def test_odometry_of_the_body_becomes_motion_of_the_camera(tmp_path: Path, rng: np.random.Generator) -> None:
    poses, times = path_of_poses(rng, 7), np.arange(7) / 10
    write_tum_rows(tmp_path / "o.tum", times, poses)
    body_T_cam = se3.se3_exp(np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.3]))
    numbers = (*body_T_cam[:3, 3].tolist(), *Rotation.from_matrix(body_T_cam[:3, :3]).as_quat().tolist())
    odometry, warnings = read_odometry(tmp_path / "o.tum", times, MeasurementsConfig(body_T_cam=numbers))
    motion, covariance = odometry.between(2, 5)
    cameras = poses @ body_T_cam
    np.testing.assert_allclose(motion, se3.inverse(cameras[2]) @ cameras[5], atol=1e-12)
    assert warnings == []
    turn = se3.adjoint(se3.inverse(body_T_cam))
    expected = np.zeros((6, 6))
    for i in range(3, 6):
        own = turn @ np.diag(np.repeat([CONFIG.odometry_sigma_rad, CONFIG.odometry_sigma_m], 3) ** 2) @ turn.T
        expected = se3.composed_covariance(expected, se3.inverse(cameras[i - 1]) @ cameras[i], own)
    np.testing.assert_allclose(covariance, expected, rtol=1e-10, atol=1e-15)


def test_the_covariance_over_rows_between_frames_is_that_of_samples(tmp_path: Path, rng: np.random.Generator) -> None:
    poses, sigmas = path_of_poses(rng, 5), rng.uniform(0.002, 0.01, size=(5, 2))
    write_tum_rows(tmp_path / "o.tum", np.arange(5) / 10, poses, sigmas)
    odometry, _ = read_odometry(tmp_path / "o.tum", np.array([0.0, 0.4]), CONFIG)
    noise = rng.normal(size=(40_000, 5, 6)) * np.repeat(sigmas, 3, axis=1)
    moved = np.tile(np.eye(4), (len(noise), 1, 1))
    for i in range(1, 5):
        moved = se3.retract(moved @ (se3.inverse(poses[i - 1]) @ poses[i]), noise[:, i])
    motion, covariance = odometry.between(0, 1)
    twist = se3.se3_log(se3.inverse(motion) @ moved)
    np.testing.assert_allclose(np.cov(twist.T), covariance, atol=0.03 * covariance.diagonal().max())


def test_frames_without_odometry_are_named_and_bridged(tmp_path: Path, rng: np.random.Generator) -> None:
    poses, times = path_of_poses(rng, 6), np.arange(6) / 10
    rows = np.array([0, 1, 4, 5])
    write_tum_rows(tmp_path / "o.tum", times[rows] + 0.003, poses[rows])
    odometry, warnings = read_odometry(tmp_path / "o.tum", times, CONFIG)
    np.testing.assert_array_equal(odometry.frame, rows)
    np.testing.assert_allclose(odometry.covariance[2], 3.0 * odometry.covariance[1])
    assert "2 of 6 frames have no odometry" in warnings[0]


def test_two_clocks_are_told(tmp_path: Path, rng: np.random.Generator) -> None:
    write_tum_rows(tmp_path / "o.tum", 1.7e9 + np.arange(4.0), path_of_poses(rng, 4))
    with pytest.raises(InputError, match=r"o\.tum: no row is within 0\.02 s of a frame.*same clock"):
        read_odometry(tmp_path / "o.tum", np.arange(4.0), CONFIG)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("2 0 0 0 0 0 0 1", "line 2: 8 columns, expected 10"),
        ("2 0 0 0 0 0 0 1 0.1 0", "line 2: sigma_rad and sigma_m must be positive"),
        ("2 0 0 0 0 0 0 1 0.1 x", "line 2: could not convert"),
    ],
)
def test_odometry_names_the_line(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "o.tum"
    path.write_text(f"1 0 0 0 0 0 0 1 0.1 0.1\n{line}\n")
    with pytest.raises(InputError, match=message):
        read_odometry(path, np.array([1.0, 2.0]), CONFIG)


def test_extrinsics_need_a_unit_quaternion(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"body_T_cam.*unit quaternion"):
        read_odometry(tmp_path / "x", np.arange(2.0), MeasurementsConfig(body_T_cam=(0, 0, 0, 0, 0, 0, 0)))


def test_geodetic_positions_are_those_of_the_ellipsoid() -> None:
    polar = 6378137.0 * (1.0 - 1.0 / 298.257223563)
    found = earth_centered(np.array([[0.0, 0.0, 0.0], [0.0, 90.0, 10.0], [90.0, 0.0, 5.0]]))
    expected = [[6378137.0, 0, 0], [0, 6378147.0, 0], [0, 0, polar + 5.0]]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    # One second of arc: about 30.9 m of latitude everywhere, and as much times the cosine of the latitude to the east.
    origin = np.array([48.0, 11.0, 500.0])
    second = 1.0 / 3600.0
    moved = origin + np.array([[second, 0, 0], [0, second, 0], [0, 0, 2.0]])
    east, north, up = east_north_up(moved, origin).T
    np.testing.assert_allclose(north, [30.8885, 0, 0], atol=0.0005)
    np.testing.assert_allclose(east, [0, 20.731, 0], atol=0.0005)
    np.testing.assert_allclose(up, [0, 0, 2.0], atol=1e-4)


def test_gps_columns_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "gps.csv"
    path.write_text("quality, z, y, x, timestamp, sigma\n4,3,2,1,0.1,0.5\n4,6,5,4,0.2,0.7\n1,9,9,9,7.0,0.7\n")
    found, warnings = read_gps(path, np.array([0.0, 0.1, 0.205]), CONFIG)
    np.testing.assert_array_equal(found.frame, [1, 2])
    np.testing.assert_array_equal(found.xyz, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(found.sigma, [[0.5] * 3, [0.7] * 3])
    assert "1 of 3 positions belong to no frame" in warnings[0]
    path.write_text("timestamp,latitude,longitude,altitude,sigma_x,sigma_y,sigma_z\n0,48,11,0,1,2,3\n1,48,11,4,1,2,3\n")
    found, _ = read_gps(path, np.array([0.0, 1.0]), CONFIG)
    np.testing.assert_allclose(found.xyz, [[0, 0, 0], [0, 0, 4]], atol=1e-6)
    np.testing.assert_array_equal(found.sigma, [[1, 2, 3], [1, 2, 3]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; expected a header"),
        ("time,x,y,z\n0,1,2,3\n", "line 1: has the columns time, x, y, z; expected a header"),
        ("timestamp,x,y,z\n", "a header and no position"),
        ("timestamp,x,y,z\n0,1,2,3\n1,2,3\n", "line 3: 3 columns, the header has 4"),
        ("timestamp,x,y,z\n0,1,2,3\n\n1,2,3,up\n", "line 4: could not convert"),
        ("timestamp,x,y,z\n0,1,2,nan\n", "line 2: a value is NaN"),
        ("timestamp,x,y,z\n1,1,2,3\n0,1,2,3\n", "line 3: timestamp is smaller"),
        ("timestamp,x,y,z,sigma\n0,1,2,3,-1\n", "line 2: a sigma must be positive"),
        ("timestamp,latitude,longitude,altitude\n0,480,11,0\n", "line 2: latitude and longitude must be degrees"),
    ],
)
def test_gps_names_the_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "gps.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"gps\.csv.*{message}"):
        read_gps(path, np.arange(3.0), CONFIG)


def test_edges_are_those_that_gtsam_writes_and_reads(tmp_path: Path, rng: np.random.Generator) -> None:
    path, poses = tmp_path / "graph.g2o", path_of_poses(rng, 6)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pairs, information = [(0, 1), (1, 2), (5, 2)], []
    for i, pose in enumerate(poses):
        values.insert(i, gtsam.Pose3(pose))
    for i, j in pairs:
        root = rng.normal(size=(6, 6)) + 3.0 * np.eye(6)
        information.append(root.T @ root)
        noise = gtsam.noiseModel.Gaussian.Information(information[-1])
        graph.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(se3.inverse(poses[i]) @ poses[j]), noise))
    gtsam.writeG2o(graph, values, str(path))
    found, warnings = read_relative_poses(path, 6)
    assert warnings == []
    read_back, _ = gtsam.readG2o(str(path), True)
    for n, (i, j) in enumerate(pairs):
        assert (found.first[n], found.second[n]) == (i, j)
        # GTSAM writes six digits.
        np.testing.assert_allclose(found.first_T_second[n], se3.inverse(poses[i]) @ poses[j], atol=1e-4)
        np.testing.assert_allclose(found.information[n], information[n], rtol=1e-3, atol=1e-3)
        theirs = read_back.at(n)
        np.testing.assert_allclose(found.first_T_second[n], theirs.measured().matrix(), atol=1e-9)
        np.testing.assert_allclose(found.information[n], theirs.noiseModel().information(), rtol=1e-9)


def test_edges_of_other_frames_are_counted(tmp_path: Path) -> None:
    path, rest = (
        tmp_path / "graph.g2o",
        "0 0 0 0 0 0 1 " + " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6)),
    )
    path.write_text(f"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nFIX 0\nEDGE_SE3:QUAT 0 1 {rest}\nEDGE_SE3:QUAT 1 9 {rest}\n")
    found, warnings = read_relative_poses(path, 5)
    assert len(found.first) == 1
    assert "1 of 2 edges are of frames that the sequence does not have (0 to 4)" in warnings[0]
    with pytest.raises(InputError, match="all 2 edges are of frames"):
        read_relative_poses(path, 1)


@pytest.mark.parametrize(
    ("edge", "message"),
    [
        ("0 1 2", "line 2: 3 numbers after EDGE_SE3:QUAT, expected 30"),
        ("0 b 0 0 0 0 0 0 1" + " 1" * 21, "line 2: invalid literal"),
        ("0 0 0 0 0 0 0 0 1" + " 1" * 21, "line 2: 0 and 0 are not two frames"),
        ("0 1 0 0 0 0 0 0 2" + " 1" * 21, "line 2: quaternion of length 2"),
        ("0 1 0 0 0 0 0 0 1" + " 1" * 21, "line 2: the information matrix is not positive definite"),
        ("0 1 0 0 nan 0 0 0 1" + " 1" * 21, "line 2: a value is NaN"),
    ],
)
def test_edges_name_the_line(tmp_path: Path, edge: str, message: str) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(f"# edges\nEDGE_SE3:QUAT {edge}\n")
    with pytest.raises(InputError, match=message):
        read_relative_poses(path, 5)


def test_a_file_without_edges_says_what_is_expected(tmp_path: Path) -> None:
    (tmp_path / "empty.g2o").write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="has no EDGE_SE3:QUAT; expected lines of EDGE_SE3:QUAT i j"):
        read_relative_poses(tmp_path / "empty.g2o", 5)
    with pytest.raises(InputError, match="no such file; a g2o file with lines of EDGE_SE3"):
        read_relative_poses(tmp_path / "none.g2o", 5)
