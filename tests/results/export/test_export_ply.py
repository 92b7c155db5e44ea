"""Clouds and line sets as Open3D reads them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.errors import OutputError
from uni4d_fg.results.clouds import write_ply
from uni4d_fg.results.export import export_run
from uni4d_fg.results.export.line_set import LineSet, write_line_set
from uni4d_fg.results.run import Run

open3d = pytest.importorskip("open3d")

Export = Callable[..., tuple[Path, object]]


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    cloud = open3d.io.read_point_cloud(str(path))
    return np.asarray(cloud.points), np.rint(np.asarray(cloud.colors) * 255)


def test_clouds_are_those_of_the_run(source: Run, exported: Export) -> None:
    folder, _ = exported("ply")
    for name, original in (
        ("static.ply", source.folder.static_cloud),
        *((f"dynamic/{frame:05d}.ply", source.folder.dynamic_cloud(frame)) for frame in range(source.num_frames)),
    ):
        for mine, theirs in zip(read(folder / name), read(original), strict=True):
            np.testing.assert_array_equal(mine, theirs)
    points, colors = read(folder / "landmarks.ply")
    np.testing.assert_allclose(points, source.reconstruction.landmarks, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(colors, source.reconstruction.landmark_color)
    assert sorted(p.name for p in folder.iterdir()) == ["dynamic", "export.json", "landmarks.ply", "static.ply"]


def test_moving_clouds_lie_on_the_moving_things(source: Run, exported: Export) -> None:
    folder, _ = exported("ply")
    result, (fx, fy, cx, cy) = source.reconstruction, source.reconstruction.intrinsics
    total = 0
    for frame, pose in enumerate(result.world_T_cam):
        points, colors = read(folder / "dynamic" / f"{frame:05d}.ply")
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        u, v = np.rint(fx * x / z + cx).astype(int), np.rint(fy * y / z + cy).astype(int)
        assert (source.need_sequence().masks[frame][v, u] > 0).all()
        np.testing.assert_array_equal(source.need_sequence().images[frame][v, u], colors)
        total += len(points)
    assert total > 100


def test_clouds_are_built_anew_when_the_run_wrote_none(source: Run, tmp_path: Path) -> None:
    other = tmp_path / "run"
    other.mkdir()
    for name in ("reconstruction.npz", "labels.npz", "depth.npy", "summary.json", "config.yaml"):
        (other / name).symlink_to(source.folder.root / name)
    (report,) = export_run(Run(other, lambda: source.need_sequence()), ["ply"], tmp_path / "out")
    for name, original in (
        ("static.ply", source.folder.static_cloud), ("dynamic/00003.ply", source.folder.dynamic_cloud(3)),
    ):  # fmt: skip
        np.testing.assert_array_equal(read(report.folder / name)[0], read(original)[0])


def test_trajectories_are_line_sets(source: Run, exported: Export) -> None:
    folder, _ = exported("ply", trajectories=True)
    result = source.reconstruction
    lines = open3d.io.read_line_set(str(folder / "trajectories.ply"))
    points, edges = np.asarray(lines.points), np.asarray(lines.lines)
    known = np.isfinite(result.dynamic_points[..., 0])
    assert len(points) == known.sum() > 50
    assert len(edges) == (known[:, 1:] & known[:, :-1]).sum()
    steps = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    expected = np.linalg.norm(np.diff(result.dynamic_points, axis=1), axis=2)
    np.testing.assert_allclose(np.sort(steps), np.sort(expected[np.isfinite(expected)]), rtol=0, atol=1e-5)
    path = open3d.io.read_line_set(str(folder / "camera_path.ply"))
    np.testing.assert_allclose(np.asarray(path.points), result.world_T_cam[:, :3, 3], rtol=0, atol=1e-6)
    assert np.asarray(path.lines).tolist() == [[t, t + 1] for t in range(source.num_frames - 1)]


def test_vertex_attributes_come_back(tmp_path: Path) -> None:
    points = np.arange(12.0).reshape(4, 3)
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3)
    frame = np.array([5, 6, 7, -1])
    write_line_set(tmp_path / "l.ply", LineSet(points, colors, np.array([[0, 1], [2, 3]]), {"frame": frame}))
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "l.ply"))
    np.testing.assert_array_equal(cloud.point["frame"].numpy().ravel(), frame)
    lines = open3d.io.read_line_set(str(tmp_path / "l.ply"))
    np.testing.assert_array_equal(np.asarray(lines.points), points)
    np.testing.assert_array_equal(np.asarray(lines.lines), [[0, 1], [2, 3]])


def test_frames_have_a_point_for_every_moving_pixel_with_normals(source: Run, exported: Export) -> None:
    folder, _ = exported("ply-frames")
    result, (fx, fy, cx, cy) = source.reconstruction, source.reconstruction.intrinsics
    _, width = result.image_size
    stems = sorted(path.stem for path in (folder / "frames").iterdir())
    assert stems == [f"{frame:05d}" for frame in range(source.num_frames)]
    for frame, pose in enumerate(result.world_T_cam):
        cloud = open3d.io.read_point_cloud(str(folder / "frames" / f"{frame:05d}.ply"))
        points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        u, v = np.rint(fx * x / z + cx).astype(int), np.rint(fy * y / z + cy).astype(int)
        mask, depth = source.need_sequence().masks[frame] > 0, source.depth[frame]  # type: ignore[index]
        assert len(np.unique(v * width + u)) == len(points)
        assert mask[v, u].all()
        np.testing.assert_allclose(z, depth[v, u], atol=1e-4)
        # Only depth edges are left out.
        assert len(points) > 0.6 * (mask & np.isfinite(depth)).sum() > 10
        np.testing.assert_array_equal(
            np.rint(np.asarray(cloud.colors) * 255), source.need_sequence().images[frame][v, u]
        )
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-4)
        assert ((normals * (pose[:3, 3] - points)).sum(axis=1) > 0).all()
    np.testing.assert_allclose(np.loadtxt(folder / "times.txt"), result.timestamps - result.timestamps[0], atol=1e-8)
    assert open3d.io.read_point_cloud(str(folder / "static.ply")).has_normals()


def test_an_empty_cloud_has_the_same_properties(tmp_path: Path) -> None:
    none = np.zeros((0, 3))
    write_ply(tmp_path / "none.ply", none, none.astype(np.uint8), none)
    write_ply(tmp_path / "one.ply", np.ones((1, 3)), np.ones((1, 3), np.uint8), np.eye(3)[:1])
    headers = [
        re.findall(rb"property (?:\w+ )+(\w+)", (tmp_path / name).read_bytes()) for name in ("none.ply", "one.ply")
    ]
    assert headers[0] == headers[1]
    with pytest.raises(OutputError, match="normals"):
        write_ply(tmp_path / "bad.ply", np.ones((2, 3)), np.ones((2, 3), np.uint8), np.ones((1, 3)))
