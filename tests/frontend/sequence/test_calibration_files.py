"""Calibrations in the files of other programs, written here as those programs write them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.calibration_files import load_calibration
from uni4d_fg.geometry.lens import PINHOLE, Lens

SIZE = (480, 640)
K = np.array([500.0, 510.0, 319.5, 239.5])
OPENCV = Lens("OPENCV", (-0.25, 0.06, 0.003, -0.002))
FISHEYE = Lens("OPENCV_FISHEYE", (0.05, -0.01, 0.004, -0.001))


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("line", "intrinsics", "lens"),
    [
        ("SIMPLE_PINHOLE 640 480 500 320 240", [500, 500, 319.5, 239.5], PINHOLE),
        ("PINHOLE 640 480 500 510 320 240", K, PINHOLE),
        ("SIMPLE_RADIAL 640 480 500 320 240 -0.1", [500, 500, 319.5, 239.5], Lens("SIMPLE_RADIAL", (-0.1,))),
        ("RADIAL 640 480 500 320 240 -0.1 0.02", [500, 500, 319.5, 239.5], Lens("RADIAL", (-0.1, 0.02))),
        ("OPENCV 640 480 500 510 320 240 -0.25 0.06 0.003 -0.002", K, OPENCV),
        ("OPENCV_FISHEYE 640 480 500 510 320 240 0.05 -0.01 0.004 -0.001", K, FISHEYE),
    ],
)
def test_colmap(tmp_path: Path, line: str, intrinsics: np.ndarray, lens: Lens) -> None:
    path = written(tmp_path / "cameras.txt", f"# Camera list with one line of data per camera:\n1 {line}\n")
    found = load_calibration(path, 5, SIZE)
    np.testing.assert_allclose(found.intrinsics, intrinsics)
    assert found.lens == lens


@pytest.mark.parametrize("delimiter", [" ", ","])
def test_a_matrix_as_text_is_the_matrix(tmp_path: Path, delimiter: str) -> None:
    matrix = np.array([[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]])
    path = tmp_path / "K.txt"
    np.savetxt(path, matrix, delimiter=delimiter, header="K")
    found = load_calibration(path, 5, SIZE)
    np.testing.assert_array_equal(found.intrinsics, K)
    assert found.lens == PINHOLE
    np.savetxt(path, matrix.T)
    with pytest.raises(InputError, match=r"K\.txt: is not a pinhole matrix"):
        load_calibration(path, 5, SIZE)


def test_a_calibration_follows_the_size_of_the_video(tmp_path: Path) -> None:
    path = written(tmp_path / "cameras.txt", "1 OPENCV 1280 960 1000 1020 640 480 -0.25 0.06 0.003 -0.002\n")
    found = load_calibration(path, 5, SIZE)
    np.testing.assert_allclose(found.intrinsics, K)
    assert found.lens == OPENCV
    with pytest.raises(InputError, match="is of images of 1280x960 px, but the video has 640x360 px; calibrate"):
        load_calibration(path, 5, (360, 640))


def test_opencv(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("camera_matrix", np.array([[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]]))
    file.write("distortion_coefficients", np.array([[*OPENCV.parameters, 0.0]]))
    file.release()
    found = load_calibration(path, 5, SIZE)
    np.testing.assert_allclose(found.intrinsics, K)
    assert found.lens == OPENCV


@pytest.mark.parametrize(("kind", "lens"), [("plumb_bob", OPENCV), ("equidistant", FISHEYE)])
def test_ros(tmp_path: Path, kind: str, lens: Lens) -> None:
    numbers = [*lens.parameters, *([0.0] if kind == "plumb_bob" else [])]
    text = (
        "image_width: 640\nimage_height: 480\ncamera_name: front\n"
        "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [500, 0, 319.5, 0, 510, 239.5, 0, 0, 1]\n"
        f"distortion_model: {kind}\ndistortion_coefficients:\n  rows: 1\n  cols: {len(numbers)}\n  data: {numbers}\n"
    )
    found = load_calibration(written(tmp_path / "front.yaml", text), 5, SIZE)
    np.testing.assert_allclose(found.intrinsics, K)
    assert found.lens == lens


@pytest.mark.parametrize(("kind", "lens"), [("radtan", OPENCV), ("equidistant", FISHEYE)])
def test_kalibr(tmp_path: Path, kind: str, lens: Lens) -> None:
    text = (
        f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: {list(lens.parameters)}\n  distortion_model: {kind}\n"
        "  intrinsics: [500.0, 510.0, 319.5, 239.5]\n  resolution: [640, 480]\n  rostopic: /cam0\n"
    )
    found = load_calibration(written(tmp_path / "camchain.yaml", text), 5, SIZE)
    np.testing.assert_allclose(found.intrinsics, K)
    assert found.lens == lens


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE])
def test_nerfstudio(tmp_path: Path, lens: Lens) -> None:
    names = ("k1", "k2", "k3", "k4") if lens.is_fisheye else ("k1", "k2", "p1", "p2")
    data = {
        "camera_model": lens.model,
        "fl_x": 500,
        "fl_y": 510,
        "cx": 320,
        "cy": 240,
        "w": 640,
        "h": 480,
        "frames": [],
    }
    data |= dict(zip(names, lens.parameters, strict=True))
    found = load_calibration(written(tmp_path / "transforms.json", json.dumps(data)), 5, SIZE)
    np.testing.assert_allclose(found.intrinsics, K)
    assert found.lens == lens


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("c.txt", "1 FOV 640 480 500 500 320 240 0.9\n", "has the camera model FOV; undistort, or use one of"),
        ("c.txt", "1 OPENCV 640 480 500 510 320 240 0.1\n", "no complete calibration .OPENCV has 8 numbers, not 5"),
        ("c.txt", "", "has 0 cameras"),
        ("c.txt", "1 PINHOLE 640 480 -500 510 320 240\n", "focal length that is not positive"),
        ("c.yaml", "a: &x [1]\nb: *x\n", "cannot be read as YAML"),
        ("c.yaml", "camera_matrix: [1, 2, 3]\n", "no complete calibration"),
        ("c.yaml", "width: 3\n", "has no camera_matrix"),
        ("c.yaml", "cam0: {}\ncam1: {}\n", "has 2 cameras"),
        (
            "c.yaml",
            "camera_matrix: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [0.1, 0.1, 0, 0, 0.2]\n",
            "has 5 distortion coefficients; calibrate with the first four",
        ),
        ("c.json", "{}", "has no camera that all frames share"),
        ("c.xml", "<x/>", "is no calibration that is known"),
    ],
)
def test_what_is_no_calibration_is_refused(tmp_path: Path, name: str, text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_calibration(written(tmp_path / name, text), 5, SIZE)


@pytest.mark.parametrize(
    ("intrinsics", "words"),
    [
        ([4.2, 4.2, 319.5, 239.5], r"focal length 4.2 px is that of no camera with images of 640 x 480 px.*in pixels"),
        ([0.9, 1.2, 0.5, 0.5], "it seems to be in mm, or normalized; give fx, fy, cx, cy in pixels"),
        ([500, 510, 1600, 1200], r"principal point \(1600.0, 1200.0\) lies outside the image of 640 x 480 px; give"),
        ([1000, 1020, 639.5, 479.5], "lies outside the image"),
    ],
)
@pytest.mark.parametrize("name", ["K.npy", "c.yaml"])
def test_other_units_and_other_images_are_refused(
    tmp_path: Path, name: str, intrinsics: list[float], words: str
) -> None:
    path = tmp_path / name
    if name == "K.npy":
        np.save(path, np.array(intrinsics))
    else:
        fx, fy, cx, cy = intrinsics
        written(path, f"camera_matrix: [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1]\n")
    with pytest.raises(InputError, match=words) as error:
        load_calibration(path, 5, SIZE)
    assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize("intrinsics", [[102.0, 102, 319.5, 239.5], [9000, 9000, 319.5, 239.5], [500, 500, 0, 479]])
def test_what_is_only_odd_is_taken(tmp_path: Path, intrinsics: list[float]) -> None:
    np.save(tmp_path / "K.npy", np.array(intrinsics))
    np.testing.assert_array_equal(load_calibration(tmp_path / "K.npy", 5, SIZE).intrinsics, intrinsics)
