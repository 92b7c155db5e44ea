"""COLMAP's files as pycolmap reads them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from export_checks import mean_reprojection_error, seen_landmarks
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from uni4d_fg.frontend.sequence.decode import read_image
from uni4d_fg.results.export import export_run
from uni4d_fg.results.export.colmap_files import ColmapModel, write_binary, write_text
from uni4d_fg.results.run import Run

pycolmap = pytest.importorskip("pycolmap")

MODELS = ("sparse/0", "sparse_text/0")


@pytest.mark.parametrize("model", MODELS)
def test_cameras_points_and_observations_are_ours(
    source: Run, exported: Callable[..., tuple[Path, object]], model: str
) -> None:
    folder, _ = exported("colmap")
    theirs, ours, seen = pycolmap.Reconstruction(folder / model), source.reconstruction, seen_landmarks(source)
    (camera,) = theirs.cameras.values()
    assert camera.model.name == "PINHOLE"
    assert (camera.height, camera.width) == ours.image_size
    np.testing.assert_allclose(camera.params, ours.intrinsics + np.array([0, 0, 0.5, 0.5]), rtol=0, atol=1e-12)
    assert theirs.num_reg_images() == ours.num_frames
    assert theirs.compute_num_observations() == len(seen.frame)
    images = sorted(theirs.images.values(), key=lambda image: image.name)
    position = np.array([theirs.points3D[i].xyz for i in sorted(theirs.points3D)])
    np.testing.assert_allclose(position, ours.landmarks[np.unique(seen.landmark)], rtol=0, atol=1e-12)
    for frame, image in enumerate(images):
        np.testing.assert_allclose(
            image.cam_from_world().matrix(), np.linalg.inv(ours.world_T_cam[frame])[:3], rtol=0, atol=1e-9
        )
        mine = seen.frame == frame
        points = [p for p in image.points2D if p.has_point3D()]
        assert len(points) == mine.sum() == len(image.points2D)
        uv = {tuple(np.round(theirs.points3D[p.point3D_id].xyz, 9)): p.xy for p in points}
        for landmark, pixel in zip(seen.landmark[mine], seen.uv[mine], strict=True):
            np.testing.assert_allclose(uv[tuple(np.round(ours.landmarks[landmark], 9))], pixel + 0.5, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_the_reprojection_error_that_we_report_is_the_one_that_colmap_finds(
    source: Run, exported: Callable[..., tuple[Path, object]], model: str
) -> None:
    folder, report = exported("colmap")
    expected = mean_reprojection_error(seen_landmarks(source))
    assert 0.05 < expected < 2.0
    theirs = pycolmap.Reconstruction(folder / model)
    assert theirs.compute_mean_reprojection_error() == pytest.approx(expected, rel=1e-9)
    theirs.update_point_3d_errors()  # computes them anew: the line before only reads what the file says
    assert theirs.compute_mean_reprojection_error() == pytest.approx(expected, rel=1e-6)
    assert report.figures["mean_reprojection_error_px"] == pytest.approx(expected, rel=1e-9)  # type: ignore[attr-defined]


def test_colmap_projects_landmarks_to_the_pixels_that_saw_them(
    source: Run, exported: Callable[..., tuple[Path, object]]
) -> None:
    folder, _ = exported("colmap")
    theirs = pycolmap.Reconstruction(folder / "sparse/0")
    offsets = []
    for image in theirs.images.values():
        for point in image.points2D:
            projected = image.project_point(theirs.points3D[point.point3D_id].xyz)
            offsets.append(projected - point.xy)
    assert len(offsets) > 500
    # A forgotten half pixel would be a bias of 0.5 in both directions.
    assert np.abs(np.median(offsets, axis=0)).max() < 0.1


def test_images_masks_and_depth_lie_where_colmap_looks(
    source: Run, exported: Callable[..., tuple[Path, object]]
) -> None:
    folder, _ = exported("colmap", depth=True)
    theirs = pycolmap.Reconstruction(folder / "sparse/0")
    names = sorted(image.name for image in theirs.images.values())
    assert names == sorted(p.name for p in (folder / "images").iterdir())
    assert source.depth is not None
    hidden = 0
    for frame, name in enumerate(names):
        np.testing.assert_array_equal(read_image(folder / "images" / name), source.need_sequence().images[frame])
        mask = cv2.imread(str(folder / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask == 0, source.need_sequence().masks[frame] > 0)
        hidden += int((mask == 0).sum())
        depth = read_colmap_array(folder / "depth_maps" / f"{name}.geometric.bin")
        np.testing.assert_array_equal(depth, np.nan_to_num(source.depth[frame], nan=0.0))
        sure = cv2.imread(str(folder / "confidence" / f"{Path(name).stem}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(sure, np.full_like(mask, round(255 * (0.9 + 0.01 * frame))))
    assert hidden > 0
    # COLMAP itself can open the pictures.
    assert pycolmap.Bitmap.read(str(folder / "images" / names[0]), True) is not None


def read_colmap_array(path: Path) -> np.ndarray:
    """A map of COLMAP's dense workspace, by its description: width & height & channels &, then float32 rows."""
    width, height, channels, data = path.read_bytes().split(b"&", 3)
    assert channels == b"1"
    return np.frombuffer(data, "<f4").reshape(int(height), int(width))


def test_masks_and_text_can_be_left_out(exported: Callable[..., tuple[Path, object]]) -> None:
    folder, _ = exported("colmap", masks=False, text=False)
    assert sorted(path.name for path in folder.iterdir()) == ["export.json", "images", "sparse"]


def test_a_run_without_tracks_gives_points_without_observations(source: Run, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(source.folder.root, bare, ignore=shutil.ignore_patterns("labels.npz", "stages"))
    (report,) = export_run(Run(bare, lambda: source.need_sequence()), ["colmap"], tmp_path / "out")
    assert "no tracks" in report.warnings[0]
    for model in MODELS:
        theirs = pycolmap.Reconstruction(report.folder / model)
        assert theirs.num_points3D() == len(source.reconstruction.landmarks)
        assert theirs.compute_num_observations() == 0


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), images=st.integers(1, 6), points=st.integers(0, 12))
def test_any_model_comes_back_from_both_encodings(tmp_path: Path, seed: int, images: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    point, image = np.nonzero(rng.random((points, images)) < 0.6)
    quaternions = rng.normal(size=(images, 4))
    model = ColmapModel(
        image_size=(int(rng.integers(1, 5000)), int(rng.integers(1, 5000))),
        intrinsics=rng.uniform(1.0, 1e4, 4),
        names=[f"bäume{i}.png" for i in range(images)],
        quaternions=quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        translations=rng.normal(size=(images, 3)) * 10.0 ** rng.integers(-6, 6),
        points=rng.normal(size=(points, 3)) * 10.0 ** rng.integers(-6, 6),
        colors=rng.integers(0, 256, (points, 3)).astype(np.uint8),
        errors=rng.random(points),
        point=point,
        image=image,
        uv=rng.uniform(-1.0, 5000.0, (len(point), 2)),
    )
    for write in (write_binary, write_text):
        folder = tmp_path / write.__name__
        folder.mkdir(exist_ok=True)
        write(model, folder)
        theirs = pycolmap.Reconstruction(folder)
        assert theirs.num_points3D() == points
        for row in range(points):
            read = theirs.points3D[row + 1]
            np.testing.assert_allclose(read.xyz, model.points[row], rtol=1e-12)
            np.testing.assert_array_equal(read.color, model.colors[row])
            seen = [
                (e.image_id - 1, tuple(theirs.images[e.image_id].points2D[e.point2D_idx].xy))
                for e in read.track.elements
            ]
            mine = point == row
            assert [i for i, _ in seen] == image[mine].tolist()
            np.testing.assert_allclose(np.reshape([uv for _, uv in seen], (-1, 2)), model.uv[mine], rtol=1e-12)
        for row in range(images):
            read = theirs.images[row + 1]
            assert read.name == model.names[row]
            np.testing.assert_allclose(read.cam_from_world().translation, model.translations[row], rtol=1e-12)
            x, y, z, w = read.cam_from_world().rotation.quat
            np.testing.assert_allclose(np.abs(np.dot([w, x, y, z], model.quaternions[row])), 1.0, rtol=0, atol=1e-12)
