"""``transforms.json`` by nerfstudio's description of its conventions, its point cloud by Open3D."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from export_checks import seen_landmarks

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.decode import read_image
from uni4d_fg.results.export import ExportOptions, export_run
from uni4d_fg.results.export.frames import depth_png
from uni4d_fg.results.run import Run

Export = Callable[..., tuple[Path, object]]


def rays(meta: dict[str, float], pose: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Directions (N, 3) of the rays of array positions, as nerfstudio documents them: through pixel centers."""
    x = (column + 0.5 - meta["cx"]) / meta["fl_x"]
    y = -(row + 0.5 - meta["cy"]) / meta["fl_y"]
    directions = np.stack((x, y, -np.ones_like(x)), axis=-1) @ pose[:3, :3].T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_rays_of_observed_pixels_meet_their_landmarks(source: Run, exported: Export) -> None:
    folder, _ = exported("nerfstudio")
    meta = json.loads((folder / "transforms.json").read_text())
    seen, landmarks = seen_landmarks(source), source.reconstruction.landmarks
    offsets = []
    for frame, entry in enumerate(meta["frames"]):
        pose, mine = np.array(entry["transform_matrix"]), seen.frame == frame
        to_point = landmarks[seen.landmark[mine]] - pose[:3, 3]
        along = rays(meta, pose, seen.uv[mine, 0], seen.uv[mine, 1])
        assert ((to_point * along).sum(axis=1) > 0).all()
        # In the camera's axes, per unit of depth, in px: x right, y up.
        both = [(v @ pose[:3, :3]) for v in (to_point, along)]
        plane = [v[:, :2] / -v[:, 2:] for v in both]
        offsets.append((plane[0] - plane[1]) * [meta["fl_x"], -meta["fl_y"]])
    offset = np.concatenate(offsets)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), seen.error, atol=1e-6)
    assert np.abs(np.median(offset, axis=0)).max() < 0.1


def test_frame_numbers_are_not_told_as_seconds(source: Run, tmp_path: Path) -> None:
    counted = dataclasses.replace(source.reconstruction, timestamps=np.arange(source.num_frames, dtype=np.float64))
    assert source.has_times
    export_run(source.with_parts(reconstruction=counted), ["nerfstudio"], tmp_path)
    frames = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())["frames"]
    assert all("timestamp" not in frame for frame in frames)
    np.testing.assert_allclose([frame["time"] for frame in frames], np.linspace(0.0, 1.0, len(frames)))


def test_frames_are_sorted_and_timed(source: Run, exported: Export) -> None:
    folder, _ = exported("nerfstudio")
    meta = json.loads((folder / "transforms.json").read_text())
    paths = [entry["file_path"] for entry in meta["frames"]]
    assert paths == sorted(paths)
    assert len(paths) == source.num_frames
    assert (meta["h"], meta["w"]) == source.reconstruction.image_size
    for frame, path in enumerate(paths):
        np.testing.assert_array_equal(read_image(folder / path), source.need_sequence().images[frame])
    times = source.reconstruction.timestamps
    np.testing.assert_allclose([e["timestamp"] for e in meta["frames"]], times, rtol=0, atol=1e-12)
    expected = (times - times[0]) / (times[-1] - times[0])
    np.testing.assert_allclose([e["time"] for e in meta["frames"]], expected, rtol=0, atol=1e-12)


def test_masks_and_depth_fit_the_images(source: Run, exported: Export) -> None:
    folder, _ = exported("nerfstudio", depth=True)
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["depth_unit_scale_factor"] == 1e-3
    for frame, entry in enumerate(meta["frames"]):
        mask = cv2.imread(str(folder / entry["mask_path"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask == 0, source.need_sequence().masks[frame] > 0)
        stored = cv2.imread(str(folder / entry["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16
        expected = np.nan_to_num(source.depth[frame], nan=0.0)  # type: ignore[index]
        np.testing.assert_allclose(stored * 1e-3, expected, rtol=0, atol=0.00051)
        sure = cv2.imread(str(folder / "confidence" / Path(entry["depth_file_path"]).name), cv2.IMREAD_UNCHANGED)
        assert sure.shape == stored.shape
        np.testing.assert_array_equal(sure, round(255 * (0.9 + 0.01 * frame)))


def test_the_point_cloud_is_in_the_same_world(source: Run, exported: Export) -> None:
    open3d = pytest.importorskip("open3d")
    folder, _ = exported("nerfstudio")
    meta = json.loads((folder / "transforms.json").read_text())
    cloud = open3d.io.read_point_cloud(str(folder / meta["ply_file_path"]))
    original = open3d.io.read_point_cloud(str(source.folder.static_cloud))
    np.testing.assert_array_equal(np.asarray(cloud.points), np.asarray(original.points))
    assert len(cloud.colors) == len(cloud.points) > 100
    pose = np.array(meta["frames"][0]["transform_matrix"])
    in_camera = (np.asarray(cloud.points) - pose[:3, 3]) @ pose[:3, :3]
    assert (in_camera[:, 2] < 0).mean() > 0.9  # in front is along -z


def test_without_masks_nothing_is_hidden(exported: Export) -> None:
    folder, _ = exported("nerfstudio", masks=False)
    meta = json.loads((folder / "transforms.json").read_text())
    assert not (folder / "masks").exists()
    assert not any("mask_path" in entry for entry in meta["frames"])


def test_depth_beyond_16_bits_is_missing() -> None:
    depth = np.array([[0.0004, 0.0006, 65.534, 65.535, 1e9, np.nan, -1.0, np.inf]], dtype=np.float32)
    stored = cv2.imdecode(np.frombuffer(depth_png(depth, Path("d.png")), np.uint8), cv2.IMREAD_UNCHANGED)
    assert stored.tolist() == [[0, 1, 65534, 0, 0, 0, 0, 0]]


def test_dense_depth_of_a_run_without_it_is_refused(source: Run, tmp_path: Path) -> None:
    bare = source.with_parts(depth=InputError("no such file"))
    with pytest.raises(InputError, match="needs dense depth"):
        export_run(bare, ["nerfstudio"], tmp_path / "out", ExportOptions(depth=True))
    assert list((tmp_path / "out").iterdir()) == []


def test_a_zoom_has_no_focal_length_of_the_whole_video(source: Run, tmp_path: Path) -> None:
    zoom = np.linspace(1.0, 1.3, source.num_frames)
    zoomed = dataclasses.replace(source.reconstruction, zoom=zoom)
    export_run(source.with_parts(reconstruction=zoomed), ["nerfstudio"], tmp_path)
    meta = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())
    # nerfstudio reads focal lengths of frames only where the file has none for all.
    assert "fl_x" not in meta
    assert "fl_y" not in meta
    np.testing.assert_allclose([frame["fl_x"] for frame in meta["frames"]], zoomed.intrinsics[0] * zoom)


def test_normals_are_where_and_as_dn_splatter_reads_them(source: Run, exported: Export) -> None:
    folder, _ = exported("nerfstudio", normals=True)
    meta = json.loads((folder / "transforms.json").read_text())
    # One file per image, in the same order: its frames are chosen by number.
    stems = [Path(entry["file_path"]).stem for entry in meta["frames"]]
    assert sorted(path.stem for path in (folder / "normals_from_pretrain").glob("*.png")) == stems
    for frame, stem in enumerate(stems):
        colors = read_image(folder / "normals_from_pretrain" / f"{stem}.png")
        normals = colors.astype(float) / 255 * 2 - 1
        known = np.isfinite(source.depth[frame])  # type: ignore[index]
        known &= np.abs(np.linalg.norm(normals, axis=2) - 1) < 0.02
        assert known.mean() > 0.7
        v, u = np.nonzero(known)
        rays_in_camera = rays(meta, np.eye(4), u.astype(float), v.astype(float))
        assert ((rays_in_camera * normals[known]).sum(axis=1) < 0.02).all()
