"""reconstruction.npz, labels.npz and depth.npy: round trips, and refusal of what is not valid."""

from __future__ import annotations

import dataclasses
import mmap
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import load_npz, save_npz
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.results.depth_store import read_depth, write_depth
from uni4d_fg.results.io import load_reconstruction, save_reconstruction
from uni4d_fg.results.labels_io import load_labels, save_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import OBJECT_ARRAYS, Reconstruction


def make_reconstruction(frames: int = 5, landmarks: int = 7, dynamic: int = 3) -> Reconstruction:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.random(frames, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(frames, 3))
    points = rng.normal(size=(dynamic, frames, 3))
    points[:, -1] = np.nan
    observed = np.ones((dynamic, frames), bool)
    observed[:, -2:] = False
    return Reconstruction(
        world_T_cam=poses,
        intrinsics=np.array([500.0, 501.0, 320.0, 240.0]),
        timestamps=np.arange(frames) / 30.0,
        image_size=(480, 640),
        depth_log_scale=rng.normal(size=frames),
        landmarks=rng.normal(size=(landmarks, 3)),
        landmark_track=np.arange(landmarks, dtype=np.int32),
        landmark_color=rng.integers(0, 256, (landmarks, 3), dtype=np.uint8),
        landmark_error=rng.random(landmarks).astype(np.float32),
        dynamic_points=points,
        dynamic_observed=observed,
        dynamic_track=np.arange(dynamic, dtype=np.int32) + 100,
        dynamic_instance=np.ones(dynamic, np.int32),
        dynamic_color=rng.integers(0, 256, (dynamic, 3), dtype=np.uint8),
    )


def with_objects(count: int = 2) -> Reconstruction:
    """A reconstruction with rigid objects that are seen from frame 1 to frame 3."""
    plain, rng = make_reconstruction(), np.random.default_rng(1)
    frames = plain.num_frames
    span = np.zeros((count, frames), bool)
    span[:, 1:4] = True
    observed = span.copy()
    observed[:, 2] = False
    random = {"covariance": (6, 6), "velocity": (6,)}
    arrays = {name: np.where(span.reshape(count, frames, *[1] * len(shape)), rng.normal(size=(count, frames, *shape)),
                             np.nan) for name, shape in random.items()}  # fmt: skip
    return dataclasses.replace(
        plain,
        object_instance=np.arange(count, dtype=np.int32) + 4,
        object_reference=np.full(count, 2, np.int32),
        object_observed=observed,
        object_world_T_object=np.where(span[..., None, None], plain.world_T_cam, np.nan),
        object_covariance=arrays["covariance"],
        object_velocity=arrays["velocity"],
    )


@pytest.mark.parametrize("count", [2, 0])
def test_rigid_objects_round_trip(tmp_path: Path, count: int) -> None:
    path = tmp_path / "reconstruction.npz"
    before = with_objects(count)
    save_reconstruction(path, before)
    after = load_reconstruction(path)
    for name in OBJECT_ARRAYS:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
        assert getattr(after, name).dtype == getattr(before, name).dtype
    save_reconstruction(path, make_reconstruction())
    assert load_reconstruction(path).object_instance is None


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"object_velocity": None}, "it has object_instance but not object_velocity"),
        ({"object_reference": np.array([2, 0], np.int32)}, "object_reference names a frame without a pose"),
        ({"object_observed": np.ones((2, 5), bool)}, "an observed rigid object has no pose"),
        ({"object_world_T_object": np.full((2, 5, 4, 4), 0.3)}, "a pose that is not a rigid transform"),
        ({"object_covariance": np.zeros((1, 5, 6, 6))}, r"object_covariance has shape \(1, 5, 6, 6\)"),
    ],
)
def test_rigid_objects_that_contradict_themselves_are_refused(
    tmp_path: Path, change: dict[str, Any], text: str
) -> None:
    with pytest.raises(OutputError, match=text):
        save_reconstruction(tmp_path / "reconstruction.npz", dataclasses.replace(with_objects(), **change))


@pytest.mark.parametrize(("landmarks", "dynamic"), [(7, 3), (0, 0), (7, 0)])
def test_reconstruction_round_trip(tmp_path: Path, landmarks: int, dynamic: int) -> None:
    path = tmp_path / "reconstruction.npz"
    reconstruction = make_reconstruction(5, landmarks, dynamic)
    save_reconstruction(path, reconstruction)
    again = load_reconstruction(path)
    for field in dataclasses.fields(Reconstruction):
        before, after = getattr(reconstruction, field.name), getattr(again, field.name)
        np.testing.assert_array_equal(after, before)
        if isinstance(before, np.ndarray):
            assert after.dtype == before.dtype
    assert again.image_size == (480, 640)
    assert [p.name for p in tmp_path.iterdir()] == ["reconstruction.npz"]


def test_covariances_are_optional(tmp_path: Path) -> None:
    path = tmp_path / "reconstruction.npz"
    covariance = np.tile(np.eye(6), (5, 1, 1))
    covariance[4] = np.nan
    known = dataclasses.replace(
        make_reconstruction(), pose_covariance=covariance, intrinsics_covariance=np.diag([1.0, 2.0, 0.0, 0.0])
    )
    save_reconstruction(path, known)
    again = load_reconstruction(path)
    np.testing.assert_array_equal(again.pose_covariance, covariance)
    np.testing.assert_array_equal(again.intrinsics_covariance, known.intrinsics_covariance)
    save_reconstruction(path, make_reconstruction())
    assert "pose_covariance" not in load_npz(path, {})
    assert load_reconstruction(path).pose_covariance is None
    with pytest.raises(OutputError, match=r"pose_covariance has shape \(4, 6, 6\)"):
        save_reconstruction(path, dataclasses.replace(known, pose_covariance=covariance[:4]))


def tamper(path: Path, **changes: Any) -> None:
    save_reconstruction(path, make_reconstruction())
    arrays = load_npz(path, {})
    save_npz(path, **{**arrays, **changes})


def scaled_pose() -> np.ndarray:
    poses = make_reconstruction().world_T_cam.copy()
    poses[3, :3, :3] *= 1.001
    return poses


def mirrored_pose() -> np.ndarray:
    poses = make_reconstruction().world_T_cam.copy()
    poses[1, :3, :3] *= -1
    return poses


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": np.int64(99)}, "format version 99"),
        ({"world_T_cam": scaled_pose()}, "pose 3 is not a rigid transform"),
        ({"world_T_cam": mirrored_pose()}, "pose 1 is not a rigid transform"),
        ({"world_T_cam": np.zeros((5, 3, 4))}, r"world_T_cam has shape \(5, 3, 4\), expected \(T, 4, 4\)"),
        ({"timestamps": np.zeros(5)}, "timestamps do not increase"),
        ({"timestamps": np.arange(4.0)}, "timestamps has shape"),
        ({"landmarks": np.full((7, 3), np.nan)}, "landmarks has a value that is NaN"),
        ({"landmarks": np.zeros((6, 3))}, "landmark_track has shape"),
        ({"landmark_track": np.zeros(7)}, "landmark_track has dtype float64"),
        ({"dynamic_points": np.full((3, 5, 3), np.nan)}, "an observed dynamic point has no position"),
        ({"dynamic_points": np.full((3, 5, 3), np.inf)}, "infinite"),
        ({"dynamic_observed": np.ones((3, 5), np.int8)}, "expected bool"),
        ({"intrinsics": np.array([-1.0, 1, 0, 0])}, "focal lengths"),
    ],
)
def test_bad_files_are_refused_by_name(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = tmp_path / "reconstruction.npz"
    tamper(path, **changes)
    with pytest.raises(InputError, match=message) as caught:
        load_reconstruction(path)
    assert str(path) in str(caught.value)


def test_an_invalid_reconstruction_is_not_written(tmp_path: Path) -> None:
    bad = dataclasses.replace(make_reconstruction(), world_T_cam=scaled_pose())
    with pytest.raises(OutputError, match="pose 3"):
        save_reconstruction(tmp_path / "reconstruction.npz", bad)
    assert not list(tmp_path.iterdir())


def test_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_reconstruction(tmp_path / "reconstruction.npz")


@pytest.mark.parametrize("with_confidence", [True, False])
def test_labels_round_trip(tmp_path: Path, with_confidence: bool) -> None:
    rng = np.random.default_rng(1)
    visible = rng.random((4, 6)) < 0.7
    uv = np.where(visible[..., None], rng.random((4, 6, 2)), np.nan).astype(np.float32)
    confidence = rng.random((4, 6)).astype(np.float32) if with_confidence else None
    blur_px = np.arange(6, dtype=np.float32) if with_confidence else None
    labelled = LabelledTracks(
        Tracks(uv, visible, np.arange(4, dtype=np.int32), confidence, blur_px),
        np.array([0, 1, 2, 3], np.int32),
        np.array([0, 5, 0, 0], np.int32),
        visible.astype(np.float32),
        np.where(visible, 2.0, np.nan).astype(np.float32),
    )
    path = tmp_path / "labels.npz"
    save_labels(path, labelled)
    again = load_labels(path)
    for name in ("uv", "visible", "query_frame", "confidence", "blur_px"):
        np.testing.assert_array_equal(getattr(again.tracks, name), getattr(labelled.tracks, name))
    for name in ("label", "instance", "weight", "depth"):
        np.testing.assert_array_equal(getattr(again, name), getattr(labelled, name))
    save_labels(path, dataclasses.replace(labelled, label=np.array([0, 1, 2, 9], np.int32)))
    with pytest.raises(InputError, match="a label is none of 0"):
        load_labels(path)
    save_labels(path, dataclasses.replace(labelled, label=np.zeros(3, np.int32)))
    with pytest.raises(InputError, match="label has shape"):
        load_labels(path)


def test_depth_round_trip_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "depth.npy"
    depth = np.random.default_rng(2).random((4, 5, 6)).astype(np.float32) + 0.1
    depth[1, 2, 3], depth[2, 0, 0], depth[3, 1, 1] = 0.0, -1.0, np.inf
    with write_depth(path, 4, (5, 6)) as writer:
        for frame in (2, 0, 3, 1):
            writer.write(frame, depth[frame])
            assert not path.exists()
    frames = read_depth(path)
    assert len(frames) == 4
    assert isinstance(frames.array, np.memmap)
    expected = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    np.testing.assert_array_equal(np.stack(list(frames)), expected)
    np.testing.assert_array_equal(np.load(path), expected)


def resident_file_pages() -> int:
    """Bytes of files that this process has in memory."""
    return int(Path("/proc/self/statm").read_text().split()[2]) * mmap.PAGESIZE


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_depth_that_was_read_does_not_stay_in_memory(tmp_path: Path) -> None:
    path, frame = tmp_path / "depth.npy", np.ones((1024, 1024), np.float32)
    with write_depth(path, 16, frame.shape) as writer:
        for number in range(16):
            writer.write(number, frame)
    before = resident_file_pages()
    depth = read_depth(path, whole=True)
    assert [float(values[-1, -1]) for values in depth] == [1.0] * 16
    assert resident_file_pages() - before < 2 * frame.nbytes


def test_interrupted_or_incomplete_depth_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "depth.npy"
    with pytest.raises(KeyError), write_depth(path, 2, (3, 3)) as writer:
        writer.write({}[0], np.ones((3, 3)))
    with pytest.raises(ValueError, match="frame 1 was not written"), write_depth(path, 2, (3, 3)) as writer:
        writer.write(0, np.ones((3, 3)))
    with pytest.raises(ValueError, match="does not fit"), write_depth(path, 2, (3, 3)) as writer:
        writer.write(2, np.ones((3, 3)))
    assert not list(tmp_path.iterdir())


def test_wrong_depth_file_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"float64 \(3, 3\), expected float32"):
        read_depth(tmp_path / "depth.npy")


def test_run_folder_names() -> None:
    folder = RunFolder(Path("run"))
    assert folder.dynamic_cloud(7) == Path("run/clouds/dynamic/00007.ply")
    assert folder.reconstruction == Path("run/reconstruction.npz")
    assert folder.scene_picture == Path("run/pictures/scene.png")
