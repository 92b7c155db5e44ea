from __future__ import annotations

import dataclasses
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from viewing_samples import NUM_FRAMES, copied, opened

from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.results import chunks as chunks_module
from uni4d_fg.results.chunks import chunks_of, even_order, spacing_of
from uni4d_fg.results.clouds import read_ply
from uni4d_fg.results.colors import (
    BRIDGED_AMBER,
    STATIC_GRAY,
    UNKNOWN_GRAY,
    instance_colors,
    value_colors,
    value_range,
)
from uni4d_fg.results.pictures.figure import thumbnail
from uni4d_fg.results.pictures.splatting import look_at
from uni4d_fg.results.run_clouds import ColoredPoints
from uni4d_fg.results.view.camera_layer import spaced_cameras
from uni4d_fg.results.view.coloring import ColorBy, Coloring, values_of
from uni4d_fg.results.view.content import Limits, RunClouds
from uni4d_fg.results.view.framing import FOV_RAD, first_view, subject_of
from uni4d_fg.results.view.trails import step_segments


def as_set(points: np.ndarray) -> set[tuple[float, ...]]:
    return set(map(tuple, np.round(points.astype(np.float64), 4).tolist()))


def test_clouds_come_from_files_thinned_to_the_limit(finished_run: Path) -> None:
    run = opened(finished_run)
    points, _ = read_ply(run.folder.static_cloud)
    assert len(points) > 500
    cloud, source = RunClouds(run, Limits(static_points=500)).static()
    assert (len(cloud.points), source) == (500, "files")
    assert as_set(cloud.points) <= as_set(points)
    again, _ = RunClouds(run, Limits(static_points=500)).static()
    np.testing.assert_array_equal(cloud.points, again.points)


def test_moving_clouds_have_every_pixel_and_know_their_instances(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.sequence is not None
    cloud = RunClouds(run, Limits()).moving(3)
    points, _ = read_ply(run.folder.dynamic_cloud(3))
    # The file has every second pixel in x and y.
    assert as_set(points) <= as_set(cloud.points)
    assert len(cloud.points) > 3 * len(points)
    assert set(cloud.instance.tolist()) == set(np.unique(run.sequence.masks[3]).tolist()) - {0}
    # Without the sequence the instance is that of the nearest trajectory, which is right for nearly all points.
    alone = RunClouds(run.with_parts(sequence=None), Limits()).moving(3)
    assert as_set(alone.points) == as_set(points)
    by_place = dict(zip(map(tuple, np.round(cloud.points, 4).tolist()), cloud.instance.tolist(), strict=True))
    same = [by_place[tuple(p)] == i for p, i in zip(np.round(alone.points, 4).tolist(), alone.instance, strict=True)]
    assert np.mean(same) > 0.9
    thin = RunClouds(run, Limits(moving_points=50 * NUM_FRAMES)).moving(3)
    assert len(thin.points) == 50


def test_a_whole_frame_is_the_frame(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.sequence is not None
    cloud = RunClouds(run, Limits()).whole_frame(2)
    height, width = run.reconstruction.image_size
    assert len(cloud.points) > 0.8 * height * width
    camera = world_to_camera(run.reconstruction.world_T_cam[2], cloud.points.astype(np.float64))
    pixel = np.rint(project(run.reconstruction.intrinsics, camera)).astype(int)
    np.testing.assert_array_equal(run.sequence.images[2][pixel[:, 1], pixel[:, 0]], cloud.colors)
    np.testing.assert_array_equal(run.sequence.masks[2][pixel[:, 1], pixel[:, 0]], cloud.instance)
    assert len(RunClouds(run.with_parts(depth=None), Limits()).whole_frame(2).points) == 0


def test_the_dense_cloud_is_the_static_scene_with_a_point_per_pixel(finished_run: Path) -> None:
    run = opened(finished_run)
    sparse, _ = RunClouds(run, Limits()).static()
    dense = RunClouds(run, Limits()).dense_static()
    assert dense is not None
    assert len(dense.points) > 3 * len(sparse.points)
    distance, _ = cKDTree(dense.points).query(sparse.points)
    # As near as a pixel's footprint at the scene's depth of about 3 m: 3 m / 120 px.
    assert np.median(distance) < 0.025
    few = RunClouds(run, Limits(static_points=2000)).dense_static()
    assert few is not None
    assert 500 < len(few.points) <= 2000
    assert RunClouds(run.with_parts(sequence=None), Limits()).dense_static() is None


def test_where_next_to_nothing_is_sure_the_dense_cloud_is_the_surer_half(finished_run: Path) -> None:
    run = opened(finished_run)
    some = np.full((run.num_frames, *run.reconstruction.image_size), 0.05, np.float32)
    some[:, :, ::2] = 0.12
    everything, half = (
        RunClouds(run.with_parts(confidence=ArrayFrames(part)), Limits()).dense_static()
        for part in (np.ones_like(some), some)
    )
    assert everything is not None
    assert half is not None
    assert 0.4 * len(everything.points) < len(half.points) < 0.95 * len(everything.points)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 3000), st.integers(40, 400), st.integers(0, 1000))
def test_chunks_hold_every_point_once_in_its_place(count: int, limit: int, seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3)) * [5.0, 1.0, 0.1]
    chunks = list(chunks_of(points, limit))
    rows = np.concatenate([chunk.rows for chunk in chunks])
    np.testing.assert_array_equal(np.sort(rows), np.arange(count))
    for chunk in chunks:
        assert len(chunk.rows) <= limit
        # What half precision holds exactly, off by half a step of a thousandth of the radius at most.
        np.testing.assert_array_equal(chunk.points.astype(np.float16).astype(np.float32), chunk.points)
        back = chunk.center + chunk.radius * chunk.points.astype(np.float64)
        assert np.abs(back - points[chunk.rows]).max() <= 0.501 * chunk.radius / 1024
    assert list(chunks_of(np.zeros((0, 3)))) == []


def test_a_large_cloud_has_no_more_chunks_than_a_browser_likes(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks_module, "CHUNK_POINTS", 100)
    monkeypatch.setattr(chunks_module, "_MOST_CHUNKS", 8)
    for count, chunks in ((90, 1), (400, 4), (700, 8), (5000, 8)):
        found = list(chunks_of(rng.random((count, 3))))
        assert len(found) == chunks
        assert sum(len(chunk.rows) for chunk in found) == count


def test_any_first_part_of_a_chunk_covers_it() -> None:
    side = np.linspace(-1.0, 1.0, 64)
    points = np.stack((*np.meshgrid(side, side), np.zeros((64, 64))), axis=-1).reshape(-1, 3)
    order = even_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(points)))
    at_random = np.random.default_rng(0).permutation(len(points))
    for part in (64, 300):
        gap, random_gap = (np.mean(cKDTree(points[o[:part]]).query(points)[0] ** 2) for o in (order, at_random))
        assert gap < 0.8 * random_gap


def test_points_are_as_large_as_their_spacing() -> None:
    grid = np.stack(np.meshgrid(np.arange(30), np.arange(30), [0]), axis=-1).reshape(-1, 3) * 0.02
    assert spacing_of(grid) == pytest.approx(0.02)
    # Dense and sparse parts of one cloud get points of their own size.
    both = np.concatenate((grid, grid * 5.0 + [10.0, 0.0, 0.0]))
    sizes = sorted(chunk.diameter for chunk in chunks_of(both, 900))
    assert sizes == pytest.approx([0.032, 0.16], rel=0.01)


def test_the_first_view_has_the_subject_beside_the_panel(finished_run: Path) -> None:
    result = opened(finished_run).reconstruction
    subject = subject_of(result, 3.0)
    known = result.dynamic_points[:, 0][np.isfinite(result.dynamic_points[:, 0]).all(axis=1)]
    assert (known.min(axis=0) <= subject).all()
    assert (subject <= known.max(axis=0)).all()
    for aspect, low, high in ((16 / 9, 0.3, 0.5), (0.46, 0.45, 0.55)):
        view = first_view(result, 3.0, aspect)
        camera = np.linalg.inv(look_at(view.position, view.look_at, view.up))
        x, y, z = (camera @ np.append(subject, 1.0))[:3]
        half = np.tan(0.5 * FOV_RAD)
        assert low < 0.5 + 0.5 * x / (z * half * aspect) < high
        assert abs(y / (z * half)) < 0.2
        # The first camera stands in the picture as well.
        x, y, z = (camera @ np.append(result.world_T_cam[0, :3, 3], 1.0))[:3]
        assert z > 0
        assert abs(x / (z * half * aspect)) < 1
        assert abs(y / (z * half)) < 1
    still = dataclasses.replace(result, dynamic_points=np.full_like(result.dynamic_points, np.nan))
    np.testing.assert_allclose(
        subject_of(still, 3.0), result.world_T_cam[0, :3, 3] + 3.0 * result.world_T_cam[0, :3, 2]
    )


def test_a_run_without_clouds_gets_them_from_depth_or_not_at_all(finished_run: Path, tmp_path: Path) -> None:
    copy = copied(finished_run, tmp_path)
    shutil.rmtree(copy / "clouds")
    run = opened(copy)
    cloud, source = RunClouds(run, Limits()).static()
    points, _ = read_ply(opened(finished_run).folder.static_cloud)
    assert source == "depth"
    np.testing.assert_allclose(np.median(cloud.points, axis=0), np.median(points, axis=0), atol=0.02)
    bare = RunClouds(run.with_parts(depth=None), Limits())
    assert bare.static()[1] == "none"
    assert len(bare.moving(0).points) == 0


def test_an_unreadable_configuration_does_not_hinder_clouds(finished_run: Path, tmp_path: Path) -> None:
    copy = copied(finished_run, tmp_path)
    (copy / "config.yaml").write_text("field_of_the_future: 3\n")
    assert len(RunClouds(opened(copy), Limits()).moving(0).points) > 0


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 6), st.integers(1, 9), st.integers(0, 1000))
def test_trails_join_known_neighbors(tracks: int, frames: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(tracks, frames, 3))
    points[rng.random((tracks, frames)) < 0.3] = np.nan
    frame = int(rng.integers(frames))
    colors = rng.integers(0, 255, (tracks, 3)).astype(np.uint8)
    ends, shades = step_segments(points, colors, frame)
    rows = [k for k in range(tracks) if frame > 0 and np.isfinite(points[k, frame - 1 : frame + 1]).all()]
    assert ends.shape == shades.shape == (len(rows), 2, 3)
    for row, segment, shade in zip(rows, ends, shades, strict=True):
        np.testing.assert_allclose(segment, points[row, frame - 1 : frame + 1], rtol=1e-6)
        assert (shade == colors[row]).all()


def test_colors_by_value_and_instance() -> None:
    low, high = value_range(np.array([0.0, 1.0, 2.0, np.nan, np.inf]))
    assert low == 0.0
    assert 1.0 < high <= 2.0
    assert value_range(np.array([np.nan])) == (0.0, 1.0)
    colors = value_colors(np.array([0.0, 5.0, np.inf, np.nan]), (0.0, 5.0))
    assert colors[1].tolist() == colors[2].tolist() != colors[0].tolist()
    assert tuple(colors[3].tolist()) == UNKNOWN_GRAY
    instances = instance_colors(np.array([0, 1, 2, 1], np.int32))
    assert tuple(instances[0].tolist()) == STATIC_GRAY
    assert instances[1].tolist() == instances[3].tolist() != instances[2].tolist()


@pytest.mark.parametrize("by", list(ColorBy))
def test_every_coloring_covers_everything_and_says_what_it_means(finished_run: Path, by: ColorBy) -> None:
    run = opened(finished_run)
    coloring = Coloring(by, run, values_of(run))
    assert coloring.landmarks().shape == run.reconstruction.landmark_color.shape
    assert coloring.trajectories(2).shape == run.reconstruction.dynamic_color.shape
    assert coloring.cameras().shape == (NUM_FRAMES, 3)
    cloud = RunClouds(run, Limits()).moving(1)
    assert coloring.cloud(cloud).shape == cloud.points.shape
    assert {"image": "video", "instance": "instance 1", "residual": "px", "uncertainty": "mm"}[
        by.value
    ] in coloring.legend()


def test_the_worst_landmark_is_the_brightest_and_bridged_points_are_marked(finished_run: Path) -> None:
    run = opened(finished_run)
    values = values_of(run)
    colors = Coloring(ColorBy.residual, run, values).landmarks()
    low, high = value_range(values.landmark_error)
    brightest = value_colors(np.array([high]), (low, high))[0]
    worst, best = np.argmax(values.landmark_error), np.argmin(values.landmark_error)
    np.testing.assert_array_equal(colors[worst], brightest)
    assert colors[worst].sum() > colors[best].sum()
    observed = run.reconstruction.dynamic_observed.copy()
    observed[0, 4] = False
    bridged = run.with_parts(reconstruction=replace(run.reconstruction, dynamic_observed=observed))
    marked = Coloring(ColorBy.uncertainty, bridged, values).trajectories(4)
    assert tuple(marked[0].tolist()) == BRIDGED_AMBER


def test_cameras_that_stand_close_are_thinned() -> None:
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(50)
    assert spaced_cameras(poses, 0.95, 100) == list(range(0, 50, 10))
    assert spaced_cameras(poses, 0.95, 3) == [0, 20, 40]
    assert spaced_cameras(np.tile(np.eye(4), (9, 1, 1)), 0.1, 5) == [0]


def test_thumbnails_are_not_wider_than_asked() -> None:
    assert thumbnail(np.zeros((100, 300, 3), np.uint8), 60).shape == (20, 60, 3)
    assert thumbnail(np.zeros((10, 30, 3), np.uint8), 60).shape == (10, 30, 3)


def test_thinning_keeps_points_with_their_colors() -> None:
    points = np.arange(300, dtype=np.float32).reshape(100, 3)
    cloud = ColoredPoints(points, points.astype(np.uint8), np.arange(100, dtype=np.int32)).thinned(10)
    assert len(cloud.points) == 10
    np.testing.assert_array_equal(cloud.points[:, 0], 3 * cloud.instance)
    np.testing.assert_array_equal(cloud.points.astype(np.uint8), cloud.colors)
