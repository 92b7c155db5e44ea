"""Clouds from depth maps: known geometry, strides, exclusions, voxels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.errors import InputError, MissingDependencyError
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.optional import import_open3d
from uni4d_fg.results.fusion.clouds import (
    Cloud,
    depth_edges,
    dilate,
    dynamic_cloud,
    dynamic_clouds,
    merge_voxels,
    static_cloud,
)

FRAMES, HEIGHT, WIDTH = 5, 24, 32
INTRINSICS = np.array([40.0, 42.0, 15.5, 11.5])
PLAIN = FusionConfig(static_stride=1, static_frame_stride=1, static_voxel_m=0.0, dynamic_stride=1)


def video() -> tuple[ArrayFrames, ArrayFrames, ArrayFrames, np.ndarray]:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth = np.full((FRAMES, HEIGHT, WIDTH), 2.0, np.float32)
    depth[:, 8:16, 10:20] = 1.0
    masks = np.zeros((FRAMES, HEIGHT, WIDTH), np.int32)
    masks[:, 8:16, 10:20] = 3
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.random(FRAMES, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(FRAMES, 3))
    return ArrayFrames(images), ArrayFrames(depth), ArrayFrames(masks), poses


def test_dynamic_points_reproject_to_their_pixels_with_their_colors() -> None:
    images, depths, masks, poses = video()
    for frame, cloud in enumerate(dynamic_clouds(images, depths, masks, INTRINSICS, poses, PLAIN)):
        uv = project(INTRINSICS, world_to_camera(poses[frame], cloud.points))
        pixels = np.rint(uv).astype(int)
        np.testing.assert_allclose(uv, pixels, atol=1e-9)
        assert len(cloud.points) == 6 * 8  # the instance without its outermost ring, a depth edge
        assert pixels.min(axis=0).tolist() == [11, 9]
        assert pixels.max(axis=0).tolist() == [18, 14]
        np.testing.assert_array_equal(cloud.colors, images[frame][pixels[:, 1], pixels[:, 0]])


def test_strides_thin_the_cloud() -> None:
    images, depths, masks, poses = video()
    whole = static_cloud(images, depths, masks, INTRINSICS, poses, PLAIN)
    config = PLAIN.model_copy(update={"static_stride": 4, "static_frame_stride": 2})
    thin = static_cloud(images, depths, masks, INTRINSICS, poses, config)
    assert 20 * len(thin.points) < len(whole.points) < 40 * len(thin.points)
    every_second = PLAIN.model_copy(update={"dynamic_stride": 2})
    cloud = dynamic_cloud(images[0], depths[0], masks[0], INTRINSICS, poses[0], every_second)
    assert len(cloud.points) == 3 * 4


def test_static_cloud_leaves_out_instances_with_a_band() -> None:
    images, _, masks, _ = video()
    flat = ArrayFrames(np.full((FRAMES, HEIGHT, WIDTH), 2.0, np.float32))
    still = np.tile(np.eye(4), (FRAMES, 1, 1))
    cloud = static_cloud(images, flat, masks, INTRINSICS, still, PLAIN, band_px=3)
    pixels = np.rint(project(INTRINSICS, cloud.points)).astype(int)
    inside = (np.abs(pixels[:, 0] - 14.5) < 5 + 3) & (pixels[:, 1] >= 8) & (pixels[:, 1] < 16)
    assert not inside.any()
    allowed = ~dilate(masks[0] > 0, 3)
    assert len(cloud.points) == FRAMES * allowed.sum()


def test_missing_depth_gives_no_point() -> None:
    images, depths, masks, poses = video()
    depth = depths[0].copy()
    depth[10, 12], depth[11, 13], depth[12, 14] = np.nan, 0.0, -1.0
    cloud = dynamic_cloud(images[0], depth, masks[0], INTRINSICS, poses[0], PLAIN)
    assert np.isfinite(cloud.points).all()
    depth = np.full_like(depth, np.nan)
    assert dynamic_cloud(images[0], depth, masks[0], INTRINSICS, poses[0], PLAIN).points.shape == (0, 3)


def test_depth_edges_mark_both_sides_and_not_slopes() -> None:
    slope = np.broadcast_to(2.0 * 1.03 ** np.arange(20), (10, 20)).astype(np.float32)
    assert not depth_edges(slope, 0.05).any()
    assert depth_edges(slope, 0.02).all()
    step = np.ones((4, 6), np.float32)
    step[:, 3:] = 2.0
    edges = depth_edges(step, 0.05)
    np.testing.assert_array_equal(edges, np.tile([False, False, True, True, False, False], (4, 1)))
    step[:, 2] = np.nan
    assert not depth_edges(step, 0.05).any()


@pytest.mark.parametrize("voxel", [0.05, 0.3, 1e-9])
def test_voxels_are_those_of_open3d(rng: np.random.Generator, voxel: float) -> None:
    try:
        open3d = import_open3d()
    except MissingDependencyError as error:
        pytest.skip(str(error))
    points, colors = rng.normal(size=(3000, 3)), rng.integers(0, 256, (3000, 3), dtype=np.uint8)
    merged = merge_voxels(Cloud(points, colors), voxel)
    fine = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    fine.colors = open3d.utility.Vector3dVector(colors.astype(np.float64))
    coarse = fine.voxel_down_sample(max(voxel, 1e-7))  # it refuses smaller ones, which hold a point each as well
    expected = np.asarray(coarse.points)
    ours, theirs = (np.lexsort(np.round(values, 9).T) for values in (merged.points, expected))
    np.testing.assert_allclose(merged.points[ours], expected[theirs], atol=1e-12)
    np.testing.assert_array_equal(merged.colors[ours], np.rint(np.asarray(coarse.colors)[theirs]).astype(np.uint8))


def test_voxels_average() -> None:
    points = np.array([[0.0, 0, 0], [0.002, 0, 0], [1.0, 0, 0]])
    colors = np.array([[0, 0, 0], [255, 100, 50], [9, 9, 9]], np.uint8)
    merged = merge_voxels(Cloud(points, colors), 0.1)
    order = np.argsort(merged.points[:, 0])
    np.testing.assert_allclose(merged.points[order], [[0.001, 0, 0], [1, 0, 0]])
    assert np.abs(merged.colors[order].astype(int) - [[128, 50, 25], [9, 9, 9]]).max() <= 1
    images, depths, masks, poses = video()
    config = PLAIN.model_copy(update={"static_voxel_m": 0.2})
    coarse = static_cloud(images, depths, masks, INTRINSICS, poses, config)
    assert 0 < len(coarse.points) < len(static_cloud(images, depths, masks, INTRINSICS, poses, PLAIN).points) / 5
    empty = merge_voxels(Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)), 0.1)
    assert len(empty.points) == 0


def test_sizes_that_disagree_are_refused() -> None:
    images, _, masks, poses = video()
    small = ArrayFrames(np.ones((FRAMES, 4, 4), np.float32))
    with pytest.raises(InputError, match="frame 0"):
        static_cloud(images, small, masks, INTRINSICS, poses, PLAIN)


def test_points_that_are_not_sure_are_no_part_of_the_static_cloud() -> None:
    images, depths, masks, poses = video()
    unsure = np.full((FRAMES, HEIGHT, WIDTH), 0.95, np.float32)
    unsure[:, :, :4] = 0.5
    whole = static_cloud(images, depths, masks, INTRINSICS, poses, PLAIN)
    sure = static_cloud(images, depths, masks, INTRINSICS, poses, PLAIN, confidence=ArrayFrames(unsure))
    assert len(whole.points) - len(sure.points) == FRAMES * HEIGHT * 4
    everything = PLAIN.model_copy(update={"cloud_confidence": 0.0})
    again = static_cloud(images, depths, masks, INTRINSICS, poses, everything, confidence=ArrayFrames(unsure))
    assert len(again.points) == len(whole.points)


def test_where_next_to_none_are_sure_the_surer_half_is_taken() -> None:
    images, depths, masks, poses = video()
    whole = static_cloud(images, depths, masks, INTRINSICS, poses, PLAIN)
    confidence = np.full((FRAMES, HEIGHT, WIDTH), 0.05, np.float32)
    confidence[:, :, : WIDTH // 2] = 0.12
    unsure = static_cloud(images, depths, masks, INTRINSICS, poses, PLAIN, confidence=ArrayFrames(confidence))
    assert 0.3 * len(whole.points) < len(unsure.points) < 0.6 * len(whole.points)
    confidence[0, :4] = 0.9  # a thirtieth of the video is enough to leave out all else
    some = static_cloud(images, depths, masks, INTRINSICS, poses, PLAIN, confidence=ArrayFrames(confidence))
    assert 0 < len(some.points) <= 4 * WIDTH
