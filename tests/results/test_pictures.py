"""Pictures: drawn for ordinary and degenerate input; the renderer's depth buffer and projection."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from uni4d_fg.errors import OutputError
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.geometry import se3
from uni4d_fg.results.pictures import draw_depth_strip, draw_scene, draw_trajectory, trajectory
from uni4d_fg.results.pictures.figure import Collage, spread_frames, upright_axes
from uni4d_fg.results.pictures.scene import times_of_the_subject
from uni4d_fg.results.pictures.splatting import View, _edge_shading, look_at, render
from uni4d_fg.slam.reconstruction import Reconstruction


def camera_path(frames: int, moving: bool = True) -> np.ndarray:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    if moving:
        poses[:, 0, 3] = np.linspace(0, 0.5, frames)
        poses[:, 1, 3] = 0.05 * np.sin(np.arange(frames))
    return poses


def make_reconstruction(frames: int, tracks: int) -> Reconstruction:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(tracks, 1, 3)) * 0.2 + [0, 0, 2] + 0.03 * np.arange(frames)[:, None] * [1.0, 0, 0]
    points[: tracks // 2, -1] = np.nan
    return Reconstruction(
        world_T_cam=camera_path(frames),
        intrinsics=np.array([100.0, 100, 49.5, 39.5]),
        timestamps=np.arange(frames) / 10,
        image_size=(80, 100),
        depth_log_scale=np.zeros(frames),
        landmarks=np.zeros((0, 3)),
        landmark_track=np.zeros(0, np.int32),
        landmark_color=np.zeros((0, 3), np.uint8),
        landmark_error=np.zeros(0, np.float32),
        dynamic_points=points,
        dynamic_observed=np.isfinite(points).all(axis=2),
        dynamic_track=np.arange(tracks, dtype=np.int32),
        dynamic_instance=np.ones(tracks, np.int32),
        dynamic_color=np.zeros((tracks, 3), np.uint8),
    )


def cloud(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    points = np.concatenate((rng.uniform(-1.5, 1.5, (count, 2)), np.full((count, 1), 3.0)), axis=1)
    return points, rng.integers(0, 256, (count, 3), dtype=np.uint8)


def read(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    assert min(picture.shape[:2]) > 100
    assert picture.std() > 3
    return picture


@pytest.mark.parametrize(
    ("frames", "moving", "truth"),
    [
        (20, True, "absent"),
        (20, True, "whole"),
        (20, True, "partly"),
        (2, True, "unknown"),
        (5, False, "whole"),
        (1, False, "absent"),
        (1, True, "whole"),
    ],
)
def test_trajectory_picture(tmp_path: Path, frames: int, moving: bool, truth: str) -> None:
    poses = camera_path(frames, moving)
    reference = None
    if truth != "absent":
        reference = se3.se3_exp(np.array([0.1, 2.0, 0.3, 1, 2, 3.0])) @ poses
    if truth == "partly" and reference is not None:
        reference[: frames // 2] = np.nan
    if truth == "unknown" and reference is not None:
        reference[:] = np.nan
    draw_trajectory(tmp_path / "pictures" / "trajectory.png", poses, reference)
    read(tmp_path / "pictures" / "trajectory.png")


@pytest.mark.parametrize(("frames", "known"), [(1, True), (3, True), (2, False)])
def test_depth_strip(tmp_path: Path, frames: int, known: bool) -> None:
    rng = np.random.default_rng(2)
    images = rng.integers(0, 256, (frames, 30, 40, 3), dtype=np.uint8)
    depth = (
        rng.uniform(1, 3, (frames, 30, 40)).astype(np.float32)
        if known
        else np.full((frames, 30, 40), np.nan, np.float32)
    )
    depth[:, :5, :5] = np.nan
    depth[:, 6, 6] = 0.0
    draw_depth_strip(tmp_path / "depth.png", ArrayFrames(images), ArrayFrames(depth), ArrayFrames(1.05 * depth))
    picture = read(tmp_path / "depth.png")
    gray = (np.abs(picture.astype(int) - [0xC3, 0xBD, 0xB9]).max(axis=2) <= 1).sum()
    assert gray > 100


@pytest.mark.parametrize(
    ("frames", "tracks", "static", "moving"), [(8, 40, 3000, 200), (8, 0, 3000, 0), (1, 3, 4, 0), (2, 0, 0, 0)]
)
def test_scene_picture(tmp_path: Path, frames: int, tracks: int, static: int, moving: int) -> None:
    draw_scene(
        tmp_path / "scene.png", make_reconstruction(frames, tracks), cloud(static), lambda _: cloud(moving), panels=2
    )
    read(tmp_path / "scene.png")


def test_pictures_leave_global_state_alone() -> None:
    code = "import sys, uni4d_fg.results.pictures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_unwritable_picture_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        draw_trajectory(tmp_path / "file" / "trajectory.png", camera_path(3))


def test_the_nearest_point_wins_and_lands_on_its_pixel() -> None:
    view = View(np.eye(4), np.array([50.0, 50, 20, 15]), (30, 40))
    points = np.array([[0.0, 0, 2], [0.0, 0, 1], [0.2, 0.1, 1], [0, 0, -1]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9]], np.uint8)
    image, depth = render(view, points, colors, np.full(4, 0.06), (255, 255, 255))
    assert depth[15, 20] == pytest.approx(1.0)
    assert image[15, 20].argmax() == 1
    assert depth[20, 30] == pytest.approx(1.0)
    assert image[20, 30].argmax() == 2
    assert np.isinf(depth[0, 0])
    np.testing.assert_array_equal(image[0, 0], [255, 255, 255])
    uv, z = view.project(points)
    np.testing.assert_allclose(uv[2], [30, 20])
    assert np.isnan(z[3])


def test_look_at_and_upright_axes() -> None:
    pose = look_at(np.array([0.0, -1, -3]), np.array([0.0, 0, 0]), np.array([0.0, -1, 0]))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert pose[1, 1] > 0.9  # image down is world down
    axes = upright_axes(camera_path(4))
    np.testing.assert_allclose(axes, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


def test_a_collage_keeps_the_pixels_of_pictures_and_is_drawn_over(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    collage = Collage(100, 80)
    panel = collage.add_picture(image, 30, 20)
    expected = np.full((80, 100, 3), 255, np.uint8)
    expected[20:60, 30:90] = image
    np.testing.assert_array_equal(collage.pixels(), expected)

    # A half-transparent square over whole pixels: units of the axes are pixels, of the picture's first one at 0.
    panel.fill(
        [9.5, 19.5, 19.5, 9.5], [4.5, 4.5, 14.5, 14.5], color=(1.0, 0.0, 0.0, 0.5), linewidth=0, antialiased=False
    )
    drawn = collage.pixels().astype(int)
    inside = (slice(25, 35), slice(40, 50))
    half = 0.5 * expected[inside] + 0.5 * np.array([255.0, 0.0, 0.0])
    assert np.abs(drawn[inside] - half).max() <= 2
    drawn[inside] = expected[inside]
    np.testing.assert_array_equal(drawn, expected)

    collage.save(tmp_path / "collage.png")
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "collage.png"))[..., ::-1], collage.pixels())


def test_edges_are_darkened_behind_what_is_in_front_and_not_beside_nothing() -> None:
    depth = np.full((20, 30), np.inf)
    depth[4:16, 3:27] = 2.0
    depth[8:12, 10:20] = 1.0
    shade = _edge_shading(depth, 1.0)
    assert shade[9, 15] == 1.0  # in front
    assert shade[4, 3] == 1.0  # beside nothing
    # Two of the eight neighbors, one pixel and three pixels away, are in front, and each darkens as much as one may.
    assert shade[9, 20] == pytest.approx(np.exp(-0.4), rel=1e-6)
    assert shade[9, 22] == pytest.approx(np.exp(-0.2), rel=1e-6)


def test_frames_are_spread() -> None:
    assert spread_frames(1, 4) == [0]
    assert spread_frames(30, 4) == [0, 10, 19, 29]
    assert spread_frames(3, 5) == [0, 1, 2]


@pytest.mark.parametrize("extent", [0.005, 0.03, 0.3, 0.9, 12.0, 1234.0])
def test_ticks_of_the_camera_path_do_not_overlap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extent: float
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(trajectory, "save_figure", lambda path, figure: drawn.append(figure))
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, 3] = extent * np.random.default_rng(0).random((20, 3))
    draw_trajectory(tmp_path / "path.png", poses)
    (figure,) = drawn
    figure.canvas.draw()
    for panel in figure.axes[:2]:
        for labels, low, high in ((panel.get_xticklabels(), "x0", "x1"), (panel.get_yticklabels(), "y0", "y1")):
            boxes = [label.get_window_extent() for label in labels if label.get_text()]
            spans = sorted((getattr(box, low), getattr(box, high)) for box in boxes)
            assert len(spans) >= 3
            assert all(second[0] > first[1] for first, second in itertools.pairwise(spans))


def test_the_scene_is_shown_while_the_subject_is_there() -> None:
    observed = np.zeros((10, 30), bool)
    observed[:, 5:20] = True
    observed[:3, 20:25] = True
    assert times_of_the_subject(observed, 4) == [5, 10, 14, 19]
    assert times_of_the_subject(np.zeros((0, 30), bool), 4) == [0, 10, 19, 29]
    assert times_of_the_subject(observed[:, :1], 4) == [0]
