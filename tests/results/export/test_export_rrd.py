"""The recording as rerun's own reader finds it."""

from __future__ import annotations

import dataclasses
import importlib
import resource
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_checks import seen_landmarks

from uni4d_fg.errors import MissingDependencyError, OutputError
from uni4d_fg.results.export import export_run
from uni4d_fg.results.export.rrd import trails
from uni4d_fg.results.run import Run

reader = pytest.importorskip("rerun.chunk")

Export = Callable[..., tuple[Path, object]]


def read(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The rows of every entity, static ones and those in time alike, as component -> value."""
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for chunk in reader.RrdReader(str(path)).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name != "rerun.controls.RowId"]
        for row in range(batch.num_rows):
            rows[chunk.entity_path].append({name: batch.column(name)[row].as_py() for name in names})
    return rows


@pytest.fixture(scope="module")
def recording(source: Run, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    (report,) = export_run(source, ["rrd"], tmp_path_factory.mktemp("rrd"))
    return read(report.folder / "scene.rrd")


def in_time(rows: list[dict[str, Any]], component: str) -> list[Any]:
    """The values of a component frame by frame."""
    timed = sorted((row for row in rows if "frame" in row and component in row), key=lambda row: row["frame"])
    assert [row["frame"] for row in timed] == list(range(len(timed)))
    return [row[component] for row in timed]


def static(rows: list[dict[str, Any]], component: str) -> Any:
    (row,) = (row for row in rows if "frame" not in row and component in row)
    return row[component]


def matrix(column_major: list[float]) -> np.ndarray:
    return np.array(column_major).reshape(3, 3).T


def test_cameras_project_landmarks_to_the_pixels_that_saw_them(source: Run, recording: Any) -> None:
    result, seen = source.reconstruction, seen_landmarks(source)
    camera = recording["/world/camera"]
    pinhole = matrix(static(recording["/world/camera/image"], "Pinhole:image_from_camera")[0])
    (resolution,) = static(recording["/world/camera/image"], "Pinhole:resolution")
    assert tuple(reversed(resolution)) == result.image_size
    assert static(recording["/world/camera/image"], "Pinhole:camera_xyz") == [[3, 2, 5]]  # right, down, forward
    translations, rotations = in_time(camera, "Transform3D:translation"), in_time(camera, "Transform3D:mat3x3")
    assert len(translations) == source.num_frames
    for frame in range(source.num_frames):
        mine = seen.frame == frame
        point = (result.landmarks[seen.landmark[mine]] - translations[frame][0]) @ matrix(rotations[frame][0])
        pixel = point @ pinhole.T
        # rerun's pixel centers are at 0.5.
        error = np.linalg.norm(pixel[:, :2] / pixel[:, 2:] - (seen.uv[mine] + 0.5), axis=1)
        np.testing.assert_allclose(error, seen.error[mine], atol=1e-3)


def test_images_are_jpegs_of_the_frames(source: Run, recording: Any) -> None:
    blobs = in_time(recording["/world/camera/image"], "EncodedImage:blob")
    assert len(blobs) == source.num_frames
    for frame, (blob,) in enumerate(blobs):
        image = cv2.imdecode(np.array(blob, dtype=np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
        difference = np.abs(image.astype(float) - source.need_sequence().images[frame])
        assert image.shape == source.need_sequence().images[frame].shape
        assert difference.mean() < 6.0


def test_clouds_are_those_of_the_run(source: Run, recording: Any) -> None:
    open3d = pytest.importorskip("open3d")

    def points(path: Path) -> np.ndarray:
        return np.asarray(open3d.io.read_point_cloud(str(path)).points)

    np.testing.assert_allclose(
        static(recording["/world/static"], "Points3D:positions"), points(source.folder.static_cloud), atol=1e-6
    )
    clouds = in_time(recording["/world/dynamic"], "Points3D:positions")
    assert len(clouds) == source.num_frames
    for frame, cloud in enumerate(clouds):
        np.testing.assert_allclose(cloud, points(source.folder.dynamic_cloud(frame)), atol=1e-6)


def test_trajectories_end_where_the_points_are(source: Run, recording: Any) -> None:
    result = source.reconstruction
    strips = in_time(recording["/world/trajectories"], "LineStrips3D:strips")
    assert len(strips) == source.num_frames
    assert strips[0] == []
    known = np.isfinite(result.dynamic_points[..., 0])
    for frame in range(1, source.num_frames):
        there = known[:, frame] & known[:, frame - 1]
        ends = np.array([strip[-1] for strip in strips[frame]])
        np.testing.assert_allclose(ends, result.dynamic_points[there, frame], atol=1e-6)
    assert max(len(strip) for strip in strips[-1]) == source.num_frames


def test_both_time_lines_agree(source: Run, recording: Any) -> None:
    times = in_time(recording["/world/camera"], "time")
    expected = source.reconstruction.timestamps - source.reconstruction.timestamps[0]
    np.testing.assert_allclose([t.total_seconds() for t in times], expected, atol=1e-5)


def test_trails_stop_at_gaps_and_at_their_length(source: Run) -> None:
    points = np.arange(5.0)[None, :, None] * np.ones((3, 1, 3))
    points[1, 1] = np.nan  # a gap
    points[2, 4] = np.nan  # not there any more
    result = type("R", (), {"dynamic_points": points})
    strips, row = trails(result, 4, 10)  # type: ignore[arg-type]
    assert row.tolist() == [0, 1]
    assert [strip[:, 0].tolist() for strip in strips] == [[0, 1, 2, 3, 4], [2, 3, 4]]
    assert [s[:, 0].tolist() for s in trails(result, 4, 2)[0]] == [[2, 3, 4], [2, 3, 4]]  # type: ignore[arg-type]
    assert trails(result, 0, 10)[0] == []  # type: ignore[arg-type]


def test_a_full_disk_is_an_error_and_leaves_nothing(source: Run, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OutputError, match=r"cannot write .*out/rrd"):
            export_run(source, ["rrd"], tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list((tmp_path / "out").iterdir()) == []


def test_without_rerun_there_is_one_sentence(source: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> Any:
        raise ModuleNotFoundError(f"No module named '{name}'", name=name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(MissingDependencyError, match=r"pip install 'uni4d-fg\[export\]'"):
        export_run(source, ["tum", "rrd"], tmp_path / "out")
    assert not (tmp_path / "out").exists()  # found before anything is written


def test_rigid_objects_are_drawn_where_they_have_a_pose(source: Run, tmp_path: Path) -> None:
    result = source.reconstruction
    poses = np.full((1, source.num_frames, 4, 4), np.nan)
    poses[0, 1:] = result.world_T_cam[1:]
    instance = result.dynamic_instance[:1]
    objects = dataclasses.replace(
        result, object_instance=instance, object_reference=np.ones(1, np.int32),
        object_observed=np.ones((1, source.num_frames), bool), object_world_T_object=poses,
    )  # fmt: skip
    changed = Run(source.folder.root, source.need_sequence)
    changed.__dict__["reconstruction"] = objects
    (report,) = export_run(changed, ["rrd"], tmp_path)
    rows = [row for row in read(report.folder / "scene.rrd")[f"/world/object_{instance[0]}"] if "frame" in row]
    drawn = {row["frame"]: row for row in rows if row.get("Transform3D:translation")}
    assert sorted(drawn) == list(range(1, source.num_frames))
    for frame, row in drawn.items():
        np.testing.assert_allclose(row["Transform3D:translation"][0], poses[0, frame, :3, 3], atol=1e-6)
        np.testing.assert_allclose(matrix(row["Transform3D:mat3x3"][0]), poses[0, frame, :3, :3], atol=1e-6)
        axes = np.array(row["Arrows3D:vectors"])
        np.testing.assert_allclose(axes, axes[0, 0] * np.eye(3), atol=1e-6)
        assert axes[0, 0] > 0
    assert [row["frame"] for row in rows if row.get("Clear:is_recursive")] == [0]
