"""Files of "Bundle Adjustment in the Large": conversion to one pinhole camera, and errors."""

from __future__ import annotations

import bz2
import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uni4d_fg.errors import InputError
from uni4d_fg.geometry.camera import project, world_to_camera


@pytest.fixture
def bal(load_benchmark: Callable[[str], Any]) -> Any:
    return load_benchmark("bal")


def scene(num_cameras: int = 6, num_points: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return observations (M, 4), cameras (T, 9) and points (N, 3) without noise."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -1.5, -1], [2, 1.5, 1], size=(num_points, 3)) * 30.0
    cameras = np.empty((num_cameras, 9))
    rows = []
    for index in range(num_cameras):
        rotation = Rotation.from_rotvec(rng.normal(scale=0.15, size=3))
        translation = rotation.apply([4.0 * index, -3.0 * index, 0.0]) - np.array([0.0, 0.0, 240.0])
        focal = rng.uniform(400, 900)
        k1, k2 = rng.uniform(-0.25, 0.1), rng.uniform(-0.05, 0.1)
        cameras[index] = [*rotation.as_rotvec(), *translation, focal, k1, k2]
        for row, point in enumerate(points):
            x, y, z = rotation.apply(point) + translation
            p = -np.array([x, y]) / z
            squared = p @ p
            u, v = focal * (1.0 + k1 * squared + k2 * squared**2) * p
            rows.append([index, row, u, v])
    return np.array(rows), cameras, points


def text(observations: np.ndarray, cameras: np.ndarray, points: np.ndarray) -> str:
    lines = [f"{len(cameras)} {len(points)} {len(observations)}"]
    lines += [f"{int(c)} {int(p)}     {u:.17e} {v:.17e}" for c, p, u, v in observations]
    lines += [f"{number:.17e}" for number in (*cameras.ravel(), *points.ravel())]
    return "\n".join(lines) + "\n"


def residuals(problem: Any) -> np.ndarray:
    points_cam = world_to_camera(problem.world_T_cam[problem.camera], problem.points[problem.point])
    return np.asarray(project(problem.intrinsics, points_cam) - problem.uv)


@pytest.mark.parametrize("suffix", ["txt", "bz2", "gz"])
def test_truth_explains_every_observation(bal: Any, tmp_path: Path, suffix: str) -> None:
    observations, cameras, points = scene()
    data = text(observations, cameras, points).encode()
    path = tmp_path / f"scene.{suffix}"
    path.write_bytes({"txt": bytes, "bz2": bz2.compress, "gz": gzip.compress}[suffix](data))
    problem = bal.read_bal(path)
    assert len(problem.uv) == len(observations)
    assert sum(problem.dropped.values()) == 0
    assert np.abs(residuals(problem)).max() < 1e-6
    assert problem.intrinsics.tolist() == [np.median(cameras[:, 6])] * 2 + [0.0, 0.0]


def test_poses_are_those_of_the_file_up_to_scale(bal: Any, tmp_path: Path) -> None:
    observations, cameras, points = scene()
    path = tmp_path / "scene.txt"
    path.write_text(text(observations, cameras, points))
    problem = bal.read_bal(path)
    scale = np.linalg.norm(problem.points) / np.linalg.norm(points)
    rotation = Rotation.from_rotvec(cameras[:, :3])
    centers = -rotation.inv().apply(cameras[:, 3:6])
    np.testing.assert_allclose(problem.points, scale * points, atol=1e-12)
    np.testing.assert_allclose(problem.world_T_cam[:, :3, 3], scale * centers, atol=1e-10)
    np.testing.assert_allclose(problem.world_T_cam[:, :3, 2], rotation.inv().apply([0, 0, -1]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(problem.world_T_cam), 1.0)
    depth = world_to_camera(problem.world_T_cam[problem.camera], problem.points[problem.point])[:, 2]
    assert np.median(depth) == pytest.approx(bal.MEDIAN_DEPTH)


@pytest.mark.parametrize("name", ["dubrovnik-3-7-pre.txt", "dubrovnik-3-7-18-pre.txt"])
def test_public_file_has_the_residuals_that_gtsam_reads(bal: Any, name: str) -> None:
    path = gtsam.findExampleDataFile(name)
    problem, data = bal.read_bal(Path(path)), gtsam.SfmData.FromBalFile(path)
    assert sum(problem.dropped.values()) == 0
    expected = np.full((len(problem.world_T_cam), len(problem.points), 2), np.nan)
    for row in range(data.numberTracks()):
        track = data.track(row)
        for index in range(track.numberMeasurements()):
            frame, uv = track.measurement(index)
            camera = data.camera(frame)
            ratio = problem.intrinsics[0] / camera.calibration().fx()
            expected[frame, row] = ratio * (camera.project(track.point3()) - uv)
    # Undistorting stretches residuals a little.
    ours, theirs = residuals(problem), expected[problem.camera, problem.point]
    assert np.linalg.norm(ours - theirs) < 0.05 * np.linalg.norm(theirs)


def test_left_out_observations_are_counted(bal: Any, tmp_path: Path) -> None:
    observations, cameras, points = scene()
    cameras[0, 7:] = -0.25, 0.0  # rises up to 2/3 * sqrt(4/3) = 0.77
    keep = observations[:, 0] > 0
    behind = np.array([[1, len(points), 10.0, 10.0]])
    folded = np.array([[1, len(points) + 1, 0.0, 0.0], [0, len(points) + 1, 0.9 * cameras[0, 6], 0.0]])
    points = np.concatenate((points, [[0.0, 0.0, 4000.0], [0.0, 0.0, 0.0]]))
    observations = np.concatenate((observations[keep], behind, folded))
    path = tmp_path / "scene.txt"
    path.write_text(text(observations, cameras, points))
    problem = bal.read_bal(path)
    assert list(problem.dropped.values()) == [1, 1, 1]
    assert len(problem.world_T_cam) == len(cameras) - 1
    assert len(problem.points) == len(points) - 2
    assert len(problem.uv) == keep.sum()
    assert "1 behind the camera, 1 without an undistorted position, 1 of points" in problem.describe()


def test_undistortion_inverts_the_polynomial_up_to_its_maximum(bal: Any) -> None:
    k1, k2 = (a.ravel() for a in np.meshgrid([-0.4, -0.1, 0.0, 0.3], [-0.2, 0.0, 0.004, 0.05, 0.5]))
    turn = np.minimum(bal._first_maximum(k1, k2), 3.0)
    for part in (0.0, 0.3, 0.9, 0.999):
        radius = part * turn
        truth = radius[:, None] * np.array([0.6, -0.8])
        good_points, good = bal.undistort(truth * (1 + k1 * radius**2 + k2 * radius**4)[:, None], k1, k2)
        assert good.all()
        np.testing.assert_allclose(good_points, truth, atol=1e-8)


def damaged(kind: str) -> str:
    observations, cameras, points = scene(2, 5)
    if kind == "camera index":
        observations[3, 0] = 2
    elif kind == "point index":
        observations[3, 1] = -1
    elif kind == "focal length":
        cameras[1, 6] = 0.0
    elif kind == "not finite":
        points[0, 0] = np.nan
    elif kind == "behind":
        cameras[:, 5] *= -1.0
    whole = text(observations, cameras, points)
    lines = whole.splitlines()
    return {
        "empty": "",
        "two counts": "2 5\n",
        "no cameras": "0 5 10\n",
        "word": whole.replace(lines[5], "1 2 here there"),
        "cut": "\n".join(lines[:-3]),
        "too long": whole + "1.0\n",
    }.get(kind, whole)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("empty", "first line must hold"),
        ("two counts", "first line must hold"),
        ("no cameras", "first line must hold"),
        ("word", "not a number"),
        ("cut", "73 numbers, but 70 follow"),
        ("too long", "73 numbers, but 74 follow"),
        ("camera index", "observation 3 is of camera 2; there are 2"),
        ("point index", "observation 3 is of point -1; there are 5"),
        ("focal length", "camera 1 has the focal length 0"),
        ("not finite", "not finite"),
        ("behind", "behind its cameras"),
    ],
)
def test_malformed_file_is_one_clear_error(bal: Any, tmp_path: Path, kind: str, message: str) -> None:
    path = tmp_path / "scene.txt"
    path.write_text(damaged(kind))
    with pytest.raises(InputError, match=message) as caught:
        bal.read_bal(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["scene.bz2", "scene.gz", "scene.txt"])
def test_damaged_compression_is_one_clear_error(bal: Any, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(gzip.compress(b"2 5 10\n")[:-6] if name.endswith("gz") else b"\x80\xff\x00")
    with pytest.raises(InputError, match=r"cannot be read|is not text"):
        bal.read_bal(path)
    with pytest.raises(InputError, match="No such file"):
        bal.read_bal(tmp_path / "absent" / name)
