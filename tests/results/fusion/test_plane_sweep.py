"""Plane sweep: the C++ version against NumPy, and both against a scene whose depth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.config.multiview import MultiviewConfig
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.multiview.sweep import Swept, sweep
from uni4d_fg.results.fusion.multiview.sweep_numpy import sweep_numpy
from uni4d_fg.results.fusion.pixel_transfer import PixelTransfer, pixel_transfer

HEIGHT, WIDTH, FOCAL = 60, 80, 80.0
K = np.array([FOCAL, FOCAL, 39.5, 29.5])
SETTINGS = {
    "radius": 2,
    "noise": 0.01,
    "difference_share": 0.4,
    "largest_difference": 0.1,
    "small_step": 30,
    "large_step": 100,
    "edge_contrast": 0.03,
}


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth pattern in [0, 1] without repetition."""
    waves = [np.sin(a * x + b * y + c) for a, b, c in ((9, 2, 0), (-3, 11, 1), (17, 13, 2), (5, -21, 3), (23, 7, 4))]
    return np.asarray(0.5 + 0.09 * np.sum(waves, axis=0), np.float32)


def view(pose: np.ndarray, box: bool = True, zoom: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Image and depth of a slanted wall, with a nearer board in front of it, seen without rotation."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    x, y = (u - K[2]) / (zoom * FOCAL), (v - K[3]) / (zoom * FOCAL)
    ox, oy, oz = pose[:3, 3]
    z = (3.0 + 0.5 * ox - oz) / (1.0 - 0.5 * x)  # the wall Z = 3 + X / 2
    image = texture(ox + x * z, oy + y * z)
    near = 1.6 - oz
    on_board = box & (np.abs(ox + x * near + 0.2) < 0.25) & (np.abs(oy + y * near) < 0.3)
    image = np.where(on_board, texture(5 + 1.3 * (ox + x * near), oy + y * near), image)
    return image.astype(np.float32), np.where(on_board, near, z)


def at(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def transfers(poses: list[np.ndarray], zoom: float = 1.0) -> list[PixelTransfer]:
    """Where cameras at poses see the pixels of the one at the origin, with so many times its focal length."""
    longer = K * np.array([zoom, zoom, 1.0, 1.0])
    return [pixel_transfer(K, longer, np.linalg.inv(pose)) for pose in poses]


def swept(poses: list[np.ndarray], image: np.ndarray) -> Swept:
    planes = np.linspace(0.2, 0.8, 48)
    return sweep(image, [view(p)[0] for p in poses], transfers(poses), planes, MultiviewConfig())


def relative_error(found: Swept, truth: np.ndarray) -> np.ndarray:
    return np.abs(1.0 / found.inverse_depth / truth - 1.0)[3:-3, 3:-3]


@pytest.mark.parametrize("motion", ["sideways", "forward"])
def test_depth_of_a_known_scene(motion: str) -> None:
    steps = [at(0, 0, z) for z in (0.3, 0.4, -0.4)]
    if motion == "sideways":
        steps = [at(0.25), at(-0.25), at(0.0, 0.25), at(0.15)]
    image, truth = view(at(0.0))
    error = relative_error(swept(steps, image), truth)
    bound = 0.01 if motion == "sideways" else 0.03  # forward, the middle of the image does not move
    assert np.median(error) < bound
    assert np.mean(error < 0.05) > (0.9 if motion == "sideways" else 0.65)


@pytest.mark.parametrize("zoom", [0.8, 1.3])
def test_depth_from_views_that_zoom(zoom: float) -> None:
    steps = [at(0.25), at(-0.25), at(0.0, 0.25), at(0.1, 0.0, 0.2)]
    image, truth = view(at(0.0))
    others = [view(pose, zoom=zoom)[0] for pose in steps]
    planes = np.linspace(0.2, 0.8, 48)
    error = relative_error(sweep(image, others, transfers(steps, zoom), planes, MultiviewConfig()), truth)
    assert np.median(error[12:-12, 12:-12]) < 0.01
    ignorant = relative_error(sweep(image, others, transfers(steps), planes, MultiviewConfig()), truth)
    assert np.median(ignorant[12:-12, 12:-12]) > 0.1


def test_differences_of_gray_values_keep_edges(rng: np.random.Generator) -> None:
    """Beside a thing in front of a wall of little contrast, windows say only where the thing is."""
    steps = [at(0.25), at(-0.25), at(0.0, 0.25), at(0.0, -0.25)]

    def seen(pose: np.ndarray) -> np.ndarray:
        image, depth = view(pose)
        weak = np.where(depth < 1.7, image, 0.4 + 0.3 * (image - 0.5))
        return np.asarray(weak + 0.003 * rng.standard_normal(image.shape), np.float32)

    image, truth = seen(at(0.0)), view(at(0.0))[1]
    board = (truth < 1.7).astype(np.uint8)
    beside = (cv2.dilate(board, np.ones((7, 7), np.uint8)) > 0) & (board == 0)
    others, planes = [seen(p) for p in steps], np.linspace(0.2, 0.8, 48)
    nearer = []
    for share in (0.0, 0.4):
        config = MultiviewConfig(difference_share=share)
        found = 1.0 / sweep(image, others, transfers(steps), planes, config).inverse_depth
        nearer.append(float(np.mean(found[beside] < 2.0)))
    assert nearer[1] < 0.6 * nearer[0]


def test_what_is_marked_moving_is_not_matched() -> None:
    image, truth = view(at(0.0))
    poses = [at(0.25), at(-0.25)]
    others = []
    for pose in poses:
        other = view(pose)[0]
        other[20:40, 30:50] = np.nan
        others.append(other)
    found = sweep(image, others, transfers(poses), np.linspace(0.2, 0.8, 48), MultiviewConfig())
    assert np.isfinite(found.inverse_depth).all()
    assert np.mean(relative_error(found, truth) < 0.05) > 0.8


@pytest.mark.parametrize(("radius", "width"), [(2, WIDTH), (1, WIDTH - 5), (7, WIDTH - 16)])
def test_cpp_and_numpy_agree(radius: int, width: int, rng: np.random.Generator) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    poses = [at(0.1, 0.02, 0.05), at(-0.12), at(0.02, -0.1)]
    image = view(at(0.0))[0][:, :width]
    image[10:14, 10:20] = np.nan
    others = np.stack([view(pose)[0][:, :width] for pose in poses])
    others += 0.005 * rng.standard_normal(others.shape).astype(np.float32)
    others[1, 30:34, 5:9] = np.nan
    camera = np.array([[FOCAL, 0, K[2]], [0, FOCAL, K[3]], [0, 0, 1]])
    turn = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0]
    turns = np.stack([camera @ (turn if i == 0 else np.eye(3)) @ np.linalg.inv(camera) for i in range(3)])
    shifts = np.stack([camera @ -pose[:3, 3] for pose in poses])
    planes, settings = np.linspace(0.2, 0.8, 40), SETTINGS | {"radius": radius}
    slow = sweep_numpy(image, others, turns, shifts, planes, **settings)
    fast = core.plane_sweep(
        image.astype(np.float64), others.astype(np.float64), turns, shifts, planes, threads=2, **settings
    )
    one = core.plane_sweep(
        image.astype(np.float64), others.astype(np.float64), turns, shifts, planes, threads=1, **settings
    )
    for a, b in zip(fast, one, strict=True):
        np.testing.assert_array_equal(a, b)
    # Costs are rounded to whole numbers, where float32 sums in another order may differ by one.
    assert np.mean(np.abs(slow[0] - fast[0]) < 0.05) > 0.995
    for a, b in zip(slow[1:], fast[1:], strict=True):
        assert np.mean(np.abs(a - b) <= 8) > 0.99


def test_bad_input_is_named() -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    image = np.zeros((20, 20))
    with pytest.raises(ValueError, match="others"):
        core.plane_sweep(
            image, np.zeros((1, 20, 19)), np.eye(3)[None], np.zeros((1, 3)), np.linspace(0.1, 1, 8), **SETTINGS
        )
    with pytest.raises(ValueError, match="inverse_depth"):
        core.plane_sweep(image, image[None], np.eye(3)[None], np.zeros((1, 3)), np.ones(2), **SETTINGS)
