"""The folder for Gaussian splatting, read by the rules of the trainers' own loaders."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from uni4d_fg.results.export import ExportOptions, export_run
from uni4d_fg.results.export.dense import without_holes
from uni4d_fg.results.run import Run

Export = Callable[..., tuple[Path, object]]


def read_cameras(path: Path) -> dict[int, tuple[int, int, tuple[float, ...]]]:
    """PINHOLE cameras of a ``cameras.bin``: id -> width, height, parameters; any other model is refused."""
    data, at = path.read_bytes(), 8
    found = {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        assert model == 1, "only undistorted datasets (PINHOLE) are supported"
        found[number] = (width, height, struct.unpack_from("<4d", data, at + 24))
        at += 24 + 32
    assert at == len(data)
    return found


def read_ply(path: Path) -> np.ndarray:
    """The vertices of a binary PLY with exactly the properties that the loader asks for."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in header.decode().splitlines()]
    kinds = {"float": "<f4", "uchar": "u1"}
    dtype = [(words[2], kinds[words[1]]) for words in lines if words[0] == "property"]
    assert {name for name, _ in dtype} == {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"}
    return np.frombuffer(body, np.dtype(dtype))


def inverse_depth(folder: Path, stem: str) -> np.ndarray:
    """What the authors' loader makes of a depth file."""
    params = json.loads((folder / "sparse" / "0" / "depth_params.json").read_text())
    median = np.median([entry["scale"] for entry in params.values()])
    assert 0.2 * median <= params[stem]["scale"] <= 5 * median, "would be taken for unreliable"
    stored = cv2.imread(str(folder / "depths" / f"{stem}.png"), -1)
    assert stored.dtype == np.uint16
    return stored.astype(np.float32) / 2.0**16 * params[stem]["scale"] + params[stem]["offset"]


def off_center(source: Run) -> Run:
    """The run with a principal point 3 px right of and 2.4 px above the middle."""
    result = source.reconstruction
    height, width = result.image_size
    intrinsics = np.array([*result.intrinsics[:2], (width - 1) / 2 + 3.0, (height - 1) / 2 - 2.4])
    return source.with_parts(reconstruction=dataclasses.replace(result, intrinsics=intrinsics))


def test_cameras_are_pinholes_with_the_middle_as_principal_point(source: Run, tmp_path: Path) -> None:
    export_run(off_center(source), ["gsplat"], tmp_path)
    height, width = source.reconstruction.image_size
    ((w, h, (_, _, cx, cy)),) = read_cameras(tmp_path / "gsplat" / "sparse" / "0" / "cameras.bin").values()
    assert (w, h) == (width - 6, height - 5)
    assert abs(cx - w / 2) < 1e-9
    assert abs(cy - h / 2) < 0.5
    for frame, path in enumerate(sorted((tmp_path / "gsplat" / "images").iterdir())):
        shown = np.asarray(Image.open(path))
        assert shown.shape == (h, w, 4)
        expected = source.need_sequence().images[frame][: height - 5, 6:]
        opaque = shown[..., 3] == 255
        np.testing.assert_array_equal(shown[..., :3][opaque], expected[opaque])


def test_what_moves_is_transparent_and_black(source: Run, exported: Export) -> None:
    folder, _ = exported("gsplat")
    for frame, path in enumerate(sorted((folder / "images").iterdir())):
        shown, mask = np.asarray(Image.open(path)), source.need_sequence().masks[frame] > 0
        hidden = shown[..., 3] == 0
        assert (hidden | (shown[..., 3] == 255)).all()
        assert hidden[mask].all()
        assert hidden.sum() < 1.6 * mask.sum()
        # The trainer multiplies what it renders by alpha, and compares with the colors as they are.
        assert (shown[hidden][:, :3] == 0).all()


def test_without_masks_the_frames_are_as_they_are(source: Run, exported: Export) -> None:
    folder, _ = exported("gsplat", masks=False)
    for frame, path in enumerate(sorted((folder / "images").iterdir())):
        np.testing.assert_array_equal(np.asarray(Image.open(path)), source.need_sequence().images[frame])


def test_pycolmap_reads_landmarks_with_observations_and_the_dense_cloud(source: Run, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    export_run(off_center(source), ["gsplat"], tmp_path)
    folder = tmp_path / "gsplat"
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    dense = read_ply(folder / "sparse" / "0" / "points3D.ply")
    tracked = [point for point in model.points3D.values() if point.track.length()]
    assert len(model.points3D) == len(tracked) + len(dense)
    assert len(tracked) > 50
    # gsplat's depth loss asks for the points of each image.
    assert {image.name for image in model.images.values()} == {p.name for p in (folder / "images").iterdir()}
    assert all(len(image.get_observation_points2D()) > 10 for image in model.images.values())
    loose = np.array([p.xyz for p in model.points3D.values() if not p.track.length()])
    np.testing.assert_allclose(np.sort(loose, axis=0), np.sort(_xyz(dense), axis=0), atol=1e-5)


def test_observations_move_with_the_crop(source: Run, exported: Export, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    result = source.reconstruction
    width = result.image_size[1]
    # A view that sees 8 columns less on the left has its principal point 8 px further left.
    intrinsics = result.intrinsics + np.array([0.0, 0.0, (width - 1) / 2 + 4.0 - result.intrinsics[2], 0.0])
    shifted = source.with_parts(reconstruction=dataclasses.replace(result, intrinsics=intrinsics))
    export_run(shifted, ["gsplat", "colmap"], tmp_path)
    cropped = pycolmap.Reconstruction(str(tmp_path / "gsplat" / "sparse" / "0"))
    whole = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    first, second = (np.array([p.xy for p in m.images[1].get_observation_points2D()]) for m in (cropped, whole))
    assert len(first) > 10
    distance = np.abs(first[:, None] + [8.0, 0.0] - second[None]).max(axis=2).min(axis=1)
    assert distance.max() < 1e-6


def test_normals_face_the_cameras_and_fit_the_surface(source: Run, exported: Export) -> None:
    folder, _ = exported("gsplat")
    dense = read_ply(folder / "sparse" / "0" / "points3D.ply")
    points, normals = _xyz(dense), np.stack([dense["nx"], dense["ny"], dense["nz"]], axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-4)
    towards = source.reconstruction.world_T_cam[:, :3, 3].mean(axis=0) - points
    assert ((towards * normals).sum(axis=1) > 0).mean() > 0.97


def test_depth_is_the_inverse_that_the_loader_expects(source: Run, exported: Export) -> None:
    folder, _ = exported("gsplat", depth=True)
    stems = sorted(path.stem for path in (folder / "images").iterdir())
    assert sorted(path.stem for path in (folder / "depths").iterdir()) == stems
    assert sorted(path.stem for path in (folder / "confidence").iterdir()) == stems
    for frame, stem in enumerate(stems):
        loaded, depth = inverse_depth(folder, stem), source.depth[frame]  # type: ignore[index]
        visible = np.asarray(Image.open(folder / "images" / f"{stem}.png"))[..., 3] > 0
        static = visible & np.isfinite(depth)
        np.testing.assert_allclose(loaded[static], 1.0 / depth[static], atol=1.5e-5 * loaded.max())
        # Nothing is missing: the loss has no mask, and zero would be a point at infinity.
        assert loaded.min() >= 0.9 * (1.0 / np.nanmax(depth))


def test_holes_take_the_nearest_value() -> None:
    known = np.zeros((5, 7), bool)
    known[2, 1], known[2, 5] = True, True
    values = np.where(known, np.array([[0, 3, 0, 0, 0, 8, 0]]), 99).astype(np.float32)
    filled = without_holes(values, known)
    assert (filled[:, :3] == 3).all()
    assert (filled[:, 4:] == 8).all()
    assert (without_holes(values, np.zeros_like(known)) == 0).all()


def test_a_zoom_has_a_camera_per_frame(source: Run, tmp_path: Path) -> None:
    zoom = np.linspace(1.0, 1.3, source.num_frames)
    result = dataclasses.replace(source.reconstruction, zoom=zoom)
    export_run(source.with_parts(reconstruction=result), ["gsplat"], tmp_path, ExportOptions(text=False))
    cameras = read_cameras(tmp_path / "gsplat" / "sparse" / "0" / "cameras.bin")
    found = [cameras[k + 1][2][0] for k in range(source.num_frames)]
    np.testing.assert_allclose(found, result.intrinsics[0] * zoom)
    assert not (tmp_path / "gsplat" / "sparse_text").exists()


def _xyz(vertices: np.ndarray) -> np.ndarray:
    return np.stack([vertices["x"], vertices["y"], vertices["z"]], axis=1).astype(np.float64)
