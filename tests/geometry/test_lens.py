"""Lens distortion against OpenCV and GTSAM, its inverse, its derivatives, and what it refuses."""

from __future__ import annotations

import cv2
import gtsam
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.errors import InputError
from uni4d_fg.factors.variable_types import FISHEYE_CAMERA, OPENCV_CAMERA
from uni4d_fg.geometry.lens import Lens, distort, distort_derivatives, fisheye, fisheye_derivatives

K = np.array([500.0, 510.0, 320.5, 241.0])
MATRIX = np.array([[K[0], 0.0, K[2]], [0.0, K[1], K[3]], [0.0, 0.0, 1.0]])
OPENCV = Lens("OPENCV", (-0.25, 0.06, 0.003, -0.002))
FISHEYE = Lens("OPENCV_FISHEYE", (0.05, -0.01, 0.004, -0.001))
SIZE = (480, 640)


def pixels(step: int = 40) -> np.ndarray:
    u, v = np.meshgrid(np.arange(0, 640, step), np.arange(0, 480, step))
    return np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)


def points(rng: np.random.Generator, n: int = 50) -> np.ndarray:
    return rng.uniform([-1.0, -0.8, 1.0], [1.0, 0.8, 4.0], size=(n, 3))


def test_the_polynomial_family_is_opencvs_and_gtsams(rng: np.random.Generator) -> None:
    x = points(rng)
    ours = OPENCV.real_pixels(K, x[:, :2] / x[:, 2:] * K[:2] + K[2:])
    theirs, _ = cv2.projectPoints(x, np.zeros(3), np.zeros(3), MATRIX, OPENCV.padded)
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-9)
    camera = OPENCV_CAMERA.to_gtsam(np.concatenate([K, OPENCV.padded]))
    gtsams = [gtsam.PinholeCameraCal3DS2(gtsam.Pose3(), camera).project(point) for point in x]
    np.testing.assert_allclose(ours, gtsams, atol=1e-9)


def test_the_fisheye_is_opencvs_and_gtsams(rng: np.random.Generator) -> None:
    x = points(rng) * [3.0, 3.0, 1.0]
    ours = np.asarray(fisheye(FISHEYE.padded, x)) * K[:2] + K[2:]
    theirs, _ = cv2.fisheye.projectPoints(x[:, None], np.zeros(3), np.zeros(3), MATRIX, FISHEYE.padded)
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-9)
    camera = FISHEYE_CAMERA.to_gtsam(np.concatenate([K, FISHEYE.padded]))
    gtsams = [gtsam.PinholeCameraCal3Fisheye(gtsam.Pose3(), camera).project(point) for point in x]
    np.testing.assert_allclose(ours, gtsams, atol=1e-9)


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE, Lens("SIMPLE_RADIAL", (0.1,)), Lens("RADIAL", (-0.1, 0.02))])
def test_ideal_pixels_undo_real_ones(lens: Lens) -> None:
    real = pixels()
    ideal = lens.ideal_pixels(K, real)
    np.testing.assert_allclose(lens.real_pixels(K, ideal), real, atol=1e-7)
    assert lens.displacement(K, SIZE) == pytest.approx(np.linalg.norm(lens.ideal_pixels(K, np.zeros(2))), rel=0.2)
    # The area of a small square of real pixels over that of its ideal pixels
    corners = np.array([[0.0, 0.0], [1e-3, 0.0], [0.0, 1e-3]])
    moved = lens.ideal_pixels(K, real[:, None] + corners)
    area = np.abs(np.linalg.det(moved[:, 1:] - moved[:, :1])) / 1e-6
    np.testing.assert_allclose(lens.magnification(K, ideal), 1.0 / area, rtol=2e-3)


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE])
def test_every_pixel_may_have_intrinsics_of_its_own(lens: Lens, rng: np.random.Generator) -> None:
    ideal = pixels()
    intrinsics = K * rng.uniform(0.8, 1.2, (len(ideal), 1))
    one_by_one = [lens.real_pixels(own, pixel) for own, pixel in zip(intrinsics, ideal, strict=True)]
    np.testing.assert_allclose(lens.real_pixels(intrinsics, ideal), one_by_one, atol=1e-9)


@given(st.floats(-0.2, 0.25), st.floats(-0.01, 0.01), st.floats(0.0, 639.0), st.floats(0.0, 479.0))
def test_the_inverse_is_exact_where_there_is_one(k1: float, p1: float, u: float, v: float) -> None:
    lens = Lens("OPENCV", (k1, 0.0, p1, 0.0))
    ideal = lens.ideal_pixels(K, np.array([u, v]))
    assert np.linalg.norm(lens.real_pixels(K, ideal) - [u, v]) < 1e-7


def test_pixels_that_nothing_reaches_are_unknown() -> None:
    lens = Lens("SIMPLE_RADIAL", (-0.6,))  # the image turns back at r = 0.745, where its radius is 0.497
    ideal = lens.ideal_pixels(K, np.array([[320.5, 241.0], [0.0, 0.0], [np.nan, 3.0]]))
    np.testing.assert_allclose(ideal[0], [320.5, 241.0])
    assert np.isnan(ideal[1:]).all()
    assert lens.displacement(K, SIZE) == float("inf")


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-6, 0.0])
def test_derivatives_hold_on_the_axis(scale: float, rng: np.random.Generator) -> None:
    x = points(rng, 8) * [scale, scale, 1.0]
    k = np.broadcast_to(FISHEYE.padded, (8, 4))
    by_point, by_parameters = fisheye_derivatives(k, x)
    for got, position in ((by_point, 1), (by_parameters, 0)):
        arguments = [torch.from_numpy(k.copy()), torch.from_numpy(x.copy())]
        arguments[position].requires_grad_(True)
        out = fisheye(*arguments)
        exact = [torch.autograd.grad(out[:, i].sum(), arguments[position], retain_graph=True)[0] for i in range(2)]
        bound = 1e-12 if scale > 1e-4 or scale == 0.0 else 1e-9
        np.testing.assert_allclose(got, torch.stack(exact, dim=1).numpy(), atol=bound)
    by_point, _ = distort_derivatives(np.broadcast_to(OPENCV.padded, (8, 4)), x[:, :2])
    step = 1e-6 * np.eye(2)
    for j in range(2):
        ahead, behind = (np.asarray(distort(OPENCV.padded, x[:, :2] + sign * step[j])) for sign in (1, -1))
        np.testing.assert_allclose(by_point[:, :, j], (ahead - behind) / 2e-6, atol=1e-8)


def test_the_fisheye_sees_behind_itself() -> None:
    theta = np.radians(100.0)
    a, b = fisheye(np.zeros(4), np.array([np.sin(theta), 0.0, np.cos(theta)]))
    assert (a, b) == (pytest.approx(theta), 0.0)


@pytest.mark.parametrize(
    ("model", "parameters", "words"),
    [
        ("FOV", (1.0,), "'FOV' is not one of PINHOLE"),
        ("RADIAL", (0.1,), "RADIAL has the distortion parameters k1, k2, got 1 numbers"),
        ("PINHOLE", (0.1,), r"PINHOLE has the distortion parameters \(none\), got 1"),
        ("SIMPLE_RADIAL", (np.nan,), "not finite"),
    ],
)
def test_what_is_no_lens_is_refused(model: str, parameters: tuple[float, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Lens(model, parameters)  # type: ignore[arg-type]
