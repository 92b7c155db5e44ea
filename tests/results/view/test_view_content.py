from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from viewing_samples import NUM_FRAMES, copied, opened

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
from uni4d_fg.results.run_clouds import ColoredPoints
from uni4d_fg.results.view.coloring import ColorBy, Coloring, values_of
from uni4d_fg.results.view.content import Limits, RunClouds
from uni4d_fg.results.view.layers import spaced_cameras
from uni4d_fg.results.view.trails import trail_segments


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


def test_moving_clouds_know_their_instances(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.sequence is not None
    cloud = RunClouds(run, Limits()).dynamic(3)
    points, _ = read_ply(run.folder.dynamic_cloud(3))
    assert as_set(cloud.points) == as_set(points)
    assert set(cloud.instance.tolist()) == set(np.unique(run.sequence.masks[3]).tolist()) - {0}
    # Without the sequence the instance is that of the nearest trajectory, which is right for nearly all points.
    alone = RunClouds(run.with_parts(sequence=None), Limits()).dynamic(3)
    assert as_set(alone.points) == as_set(points)
    by_place = dict(zip(map(tuple, np.round(cloud.points, 4).tolist()), cloud.instance.tolist(), strict=True))
    same = [by_place[tuple(p)] == i for p, i in zip(np.round(alone.points, 4).tolist(), alone.instance, strict=True)]
    assert np.mean(same) > 0.9


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
    assert len(bare.dynamic(0).points) == 0


def test_an_unreadable_configuration_does_not_hinder_clouds(finished_run: Path, tmp_path: Path) -> None:
    copy = copied(finished_run, tmp_path)
    (copy / "config.yaml").write_text("field_of_the_future: 3\n")
    assert len(RunClouds(opened(copy), Limits()).dynamic(0).points) > 0


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 6), st.integers(1, 9), st.integers(0, 12), st.randoms(use_true_random=False))
def test_trails_join_known_neighbors_up_to_the_frame(tracks: int, frames: int, length: int, random: object) -> None:
    rng = np.random.default_rng(random.randrange(1 << 30))  # type: ignore[attr-defined]
    points = rng.normal(size=(tracks, frames, 3))
    points[rng.random((tracks, frames)) < 0.3] = np.nan
    frame = int(rng.integers(frames))
    colors = np.full((tracks, 3), 200, np.uint8)
    ends, shades = trail_segments(points, colors, frame, length)
    known = np.isfinite(points).all(axis=2)
    expected = sum(
        bool(known[k, t - 1] and known[k, t])
        for k in range(tracks)
        for t in range(max(1, frame - length + 1), frame + 1)
    )
    assert ends.shape == shades.shape == (expected, 2, 3)
    assert np.isfinite(ends).all()
    last = np.isclose(ends[:, None, 1], points[None, :, frame].astype(np.float32), atol=1e-6).all(axis=2).any(axis=1)
    assert (shades[last, 1] == 200).all()
    assert (shades[:, 0] < shades[:, 1]).all()


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
    cloud = RunClouds(run, Limits()).dynamic(1)
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
