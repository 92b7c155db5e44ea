"""The native layout: round trip, optional parts, and one clear error for each kind of damage."""

from __future__ import annotations

import dataclasses
import errno
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sequence_samples import (
    FRAMES,
    HEIGHT,
    TRACKS,
    WIDTH,
    cut_file,
    native_folder,
    rewrite_npz,
    sample_sequence,
    write_image,
)
from test_frames import make_video

from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.frontend.sequence import write
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Sequence
from uni4d_fg.frontend.sequence.native import is_native_layout, read_native
from uni4d_fg.frontend.sequence.validate import validate_sequence
from uni4d_fg.frontend.sequence.write import write_native


def assert_same(read: Sequence, written: Sequence) -> None:
    assert read.num_frames == written.num_frames
    assert read.image_size == written.image_size
    for mine, other in ((read.images, written.images), (read.masks, written.masks)):
        np.testing.assert_array_equal(np.stack(list(mine)), np.stack(list(other)))
    np.testing.assert_array_equal(np.stack(list(read.depths)), np.stack(list(written.depths)))
    np.testing.assert_array_equal(read.intrinsics, written.intrinsics)
    assert (read.tracks is None) == (written.tracks is None)
    if read.tracks is not None and written.tracks is not None:
        np.testing.assert_array_equal(read.tracks.uv, written.tracks.uv)
        np.testing.assert_array_equal(read.tracks.visible, written.tracks.visible)
        np.testing.assert_array_equal(read.tracks.query_frame, written.tracks.query_frame)
        np.testing.assert_array_equal(read.tracks.confidence, written.tracks.confidence)


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 1000),
    far=st.booleans(),
    frames=st.integers(2, 5),
    ids=st.sampled_from([(0,), (0, 1), (0, 255), (0, 256), (0, 3, 256**3 - 1)]),
    num_tracks=st.integers(0, 4),
)
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    far: bool,
    frames: int,
    ids: tuple[int, ...],
    num_tracks: int,
) -> None:
    written = sample_sequence(seed, frames, far, ids, num_tracks)
    root = tmp_path_factory.mktemp("native") / "kitchen"
    write_native(written, root)
    assert (root / "depth_cue").is_dir() != far
    assert (root / "depth_cue.npy").is_file() == far
    read = read_native(root)
    assert_same(read, written)
    assert (read.name, read.root, read.frame_names) == ("kitchen", root, written.frame_names)
    np.testing.assert_array_equal(read.timestamps, written.timestamps)
    np.testing.assert_allclose(read.initial_world_T_cam, written.initial_world_T_cam, atol=1e-12)
    truth, written_truth = read.ground_truth, written.ground_truth
    np.testing.assert_allclose(truth.world_T_cam, written_truth.world_T_cam, atol=1e-12)
    np.testing.assert_array_equal(truth.intrinsics, written_truth.intrinsics)
    np.testing.assert_array_equal(truth.track_points, written_truth.track_points)
    np.testing.assert_array_equal(truth.rigid_instance, written_truth.rigid_instance)
    np.testing.assert_array_equal(truth.world_T_object, written_truth.world_T_object)
    assert truth.depths is not None
    assert written_truth.depths is not None
    np.testing.assert_array_equal(np.stack(list(truth.depths)), np.stack(list(written_truth.depths)))
    assert validate_sequence(root).ok


def test_true_object_poses_that_do_not_fit_are_refused_and_older_files_are_read(tmp_path: Path) -> None:
    written = sample_sequence()
    write_native(written, tmp_path / "a")
    truth = written.ground_truth
    assert truth.world_T_object is not None
    path = tmp_path / "a" / "ground_truth.npz"
    older = {"intrinsics": truth.intrinsics, "track_points": truth.track_points}
    np.savez(path, **older)
    read = read_native(tmp_path / "a").ground_truth
    assert read.rigid_instance is None
    assert read.world_T_object is None
    np.testing.assert_array_equal(read.track_points, truth.track_points)
    for poses in (truth.world_T_object[:, :-1], truth.world_T_object[:1]):
        np.savez(path, **older, rigid_instance=truth.rigid_instance, world_T_object=poses)
        with pytest.raises(InputError, match="world_T_object"):
            read_native(tmp_path / "a")
    np.savez(path, **older, rigid_instance=truth.rigid_instance)
    with pytest.raises(InputError, match="world_T_object"):
        read_native(tmp_path / "a")


def test_only_the_necessary(tmp_path: Path) -> None:
    bare = dataclasses.replace(
        sample_sequence(), tracks=None, initial_world_T_cam=None, ground_truth=GroundTruth(), frame_names=()
    )
    write_native(bare, tmp_path / "a")
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == [
        "K.npy", "depth_cue", "masks", "rgb", "timestamps.txt",
    ]  # fmt: skip
    shutil.rmtree(tmp_path / "a" / "masks")
    (tmp_path / "a" / "K.npy").unlink()
    (tmp_path / "a" / "timestamps.txt").unlink()
    read = read_native(tmp_path / "a")
    assert read.frame_names == ("00000", "00001", "00002", "00003")
    np.testing.assert_array_equal(read.intrinsics, [16, 16, 7.5, 5.5])
    np.testing.assert_array_equal(read.timestamps, [0, 1, 2, 3])
    assert read.tracks is None
    assert read.ground_truth == GroundTruth()
    assert not read.masks[3].any()


@pytest.mark.parametrize("names", [("b", "a", "c", "d"), ("a", "a", "b", "c"), ("a", "../b", "c", "d"), ("x",)])
def test_names_that_would_change_the_order_become_numbers(tmp_path: Path, names: tuple[str, ...]) -> None:
    written = dataclasses.replace(sample_sequence(), frame_names=names)
    write_native(written, tmp_path / "a")
    read = read_native(tmp_path / "a")
    assert read.frame_names == ("00000", "00001", "00002", "00003")
    assert_same(read, written)


def test_per_frame_intrinsics_are_averaged(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    per_frame = np.tile(np.load(root / "K.npy"), (FRAMES, 1, 1))
    per_frame[:, 0, 0] = [100.0, 100.4, 99.6, 100.8]
    np.save(root / "K.npy", per_frame)
    assert read_native(root).intrinsics[0] == pytest.approx(100.2)
    per_frame[2, 0, 0] = 110.0
    np.save(root / "K.npy", per_frame)
    with pytest.raises(InputError, match=r"changes along the video \(frame 2"):
        read_native(root)


def test_depth_choices(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    np.save(root / "depth.npy", np.full((FRAMES, 1, HEIGHT, WIDTH), 9.0, np.float32))
    assert read_native(root).depths[0][1, 1] < 5
    assert read_native(root, depth="depth").depths[0][1, 1] == 9.0
    (root / "depth_cue").rename(root / "other")
    assert read_native(root).depths[0][1, 1] == 9.0
    assert is_native_layout(root)
    assert read_native(root, depth="other").depths[0][1, 1] < 5
    (root / "other.npy").write_bytes(b"")
    with pytest.raises(InputError, match=r"has two depth cues, other and other\.npy"):
        read_native(root, depth="other")
    with pytest.raises(InputError, match=r"neither nothing/ nor nothing\.npy is there \(found depth_gt/, masks/"):
        read_native(root, depth="nothing")


def test_video_instead_of_images(tmp_path: Path) -> None:
    make_video(tmp_path / "video.mp4", 6)
    np.save(tmp_path / "depth.npy", np.ones((6, 48, 64), np.float32))
    sequence = read_native(tmp_path)
    assert (sequence.num_frames, sequence.image_size) == (6, (48, 64))
    np.testing.assert_allclose(sequence.timestamps, np.arange(6) / 12.5)
    assert sequence.frame_names[5] == "00005"
    report = validate_sequence(tmp_path)
    assert report.ok
    assert [f.item for f in report.of("warning")] == ["intrinsics"]


def test_observations_outside_the_image_are_not_visible(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    tracks = sample_sequence().tracks
    assert tracks is not None
    uv, visible = tracks.uv.copy(), tracks.visible.copy()
    visible[0] = [True, True, True, False]
    uv[0] = [[WIDTH - 1, HEIGHT - 1], [WIDTH, 0], [3, -0.01], [5, 5]]
    rewrite_npz(root / "tracks.npz", uv=uv, visible=visible.astype(float))
    read = read_native(root).tracks
    assert read is not None
    np.testing.assert_array_equal(read.visible[0], [True, False, False, False])
    np.testing.assert_array_equal(np.isnan(read.uv[..., 0]), ~read.visible)
    np.testing.assert_array_equal(read.uv[0, 0], [WIDTH - 1, HEIGHT - 1])
    assert any("2 visible observations lie outside" in f.message for f in validate_sequence(root).of("warning"))


def pose_change(frame: int, row: object) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        poses = np.load(root / "c2w.npy")
        poses[frame, : np.shape(row)[0]] = row
        np.save(root / "c2w.npy", poses)

    return change


def nan_track(root: Path) -> None:
    uv = np.full((TRACKS, FRAMES, 2), 2.0)
    uv[3, 1, 0] = np.nan
    rewrite_npz(root / "tracks.npz", uv=uv, visible=np.ones((TRACKS, FRAMES), bool))


def saver(name: str, array: object) -> Callable[[Path], None]:
    return lambda root: np.save(root / name, np.asarray(array), allow_pickle=True)


def tracks_with(**changes: object) -> Callable[[Path], None]:
    return lambda root: rewrite_npz(root / "tracks.npz", **changes)


def text(content: str) -> Callable[[Path], None]:
    return lambda root: (root / "timestamps.txt").write_text(content) and None


def k_matrix(row: int, column: int, value: float) -> Callable[[Path], None]:
    matrix = np.array([[20.0, 0, 7], [0, 20, 5], [0, 0, 1]])
    matrix[row, column] = value
    return saver("K.npy", matrix)


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "first image cut": (lambda r: cut_file(r / "rgb" / "frame_0000.png"), r"frame_0000\.png: is cut short"),
    "no rgb": (lambda r: shutil.rmtree(r / "rgb"), "has no rgb/ folder and no video"),
    "rgb empty": (
        lambda r: [p.unlink() for p in (r / "rgb").iterdir()],
        r"rgb: has no \.png, \.jpg, \.jpeg file \(it is empty\)",
    ),
    "image missing": (lambda r: (r / "rgb" / "frame_0002.png").unlink(), "has 4 frames, but there are 3 images"),
    "depth size": (
        lambda r: write_image(r / "depth_cue" / "frame_0000.png", np.ones((5, 5), np.uint16)),
        "is 5 x 5 px, but the first image is 16 x 12 px",
    ),
    "depth 8 bit": (
        lambda r: write_image(r / "depth_cue" / "frame_0000.png", np.ones((HEIGHT, WIDTH), np.uint8)),
        "a picture of depth is not depth",
    ),
    "mask size": (
        lambda r: write_image(r / "masks" / "frame_0000.png", np.zeros((HEIGHT, WIDTH + 1), np.uint8)),
        "masks.*is 17 x 12 px",
    ),
    "mask missing": (lambda r: (r / "masks" / "frame_0000.png").unlink(), "masks: has 3 frames"),
    "jpeg masks": (
        lambda r: [p.rename(p.with_suffix(".jpg")) for p in list((r / "masks").iterdir())],
        r"masks: has no \.png, \.npy file \(it holds frame_0000\.jpg",
    ),
    "K shape": (saver("K.npy", np.ones(5)), r"K\.npy: has shape \(5,\)"),
    "K count": (saver("K.npy", np.ones((3, 3, 3))), "has 3 matrices for 4 frames"),
    "K nan": (k_matrix(0, 2, np.nan), r"K\.npy: has NaN"),
    "K focal": (k_matrix(0, 0, -5), "focal length of -5 px"),
    "K skew": (k_matrix(0, 1, 3), "skew of 3 px"),
    "K transposed": (k_matrix(2, 0, 7), "not a pinhole matrix"),
    "K text": (saver("K.npy", "text"), "not numeric"),
    "poses shape": (saver("c2w.npy", np.ones((FRAMES, 3, 4))), r"save poses as \(4, 4, 4\)"),
    "poses count": (saver("c2w.npy", np.ones((3, 4, 4))), r"c2w\.npy: has shape \(3, 4, 4\) for 4 frames"),
    "poses nan": (pose_change(2, [[np.nan] * 4]), r"NaN or infinite entries in frame\(s\) 2"),
    "poses scaled": (
        pose_change(1, 2 * np.eye(4)[:3]), r"not orthonormal and right-handed in frame\(s\) 1",
    ),
    "poses mirrored": (pose_change(1, np.diag([1, 1, -1, 1])[:3]), "not orthonormal and right-handed"),
    "poses transposed": (
        pose_change(3, np.eye(4) + np.tri(4, k=-1)), r"bottom row other than 0 0 0 1 in frame\(s\) 3",
    ),
    "times text": (text("0\n1\nx\n3\n"), r"timestamps\.txt: line 3: 'x' is not a number"),
    "times count": (text("0\n1\n"), "has 2 timestamps for 4 frames"),
    "times order": (text("0\n1\n1\n3\n"), r"does not increase after frame\(s\) 1"),
    "times nan": (text("0\n1\nnan\n3\n"), "NaN or infinite timestamp"),
    "tracks cut": (lambda r: cut_file(r / "tracks.npz"), r"tracks\.npz: not a readable \.npz file, or cut short"),
    "tracks key": (tracks_with(visible=None), r"tracks\.npz: lacks 'visible'"),
    "tracks object": (tracks_with(uv=np.array([None])), "holds Python objects"),
    "tracks rank": (tracks_with(uv=np.zeros((TRACKS, 2))), "3 dimensions are expected"),
    "tracks frames": (
        tracks_with(uv=np.zeros((TRACKS, 9, 2)), visible=np.ones((TRACKS, 9), bool), confidence=None),
        "tracks span 9 frames, but the video has 4",
    ),
    "tracks shapes": (tracks_with(uv=np.zeros((3, FRAMES, 2))), r"uv has shape \(3, 4, 2\) but visible has \(5, 4\)"),
    "tracks query": (tracks_with(query_frame=np.full(TRACKS, 4)), "not frames 0 to 3"),
    "tracks query shape": (tracks_with(query_frame=np.zeros(2)), r"query_frame has shape \(2,\)"),
    "tracks soft": (tracks_with(visible=np.full((TRACKS, FRAMES), 0.5)), "values other than 0 and 1"),
    "tracks confidence": (tracks_with(confidence=np.full((TRACKS, FRAMES), 80.0)), r"outside \[0, 1\]"),
    "tracks nan": (nan_track, r"1 visible observations are NaN or infinite \(first: track 3, frame 1\)"),
    "truth points": (
        lambda r: rewrite_npz(r / "ground_truth.npz", track_points=np.zeros((2, FRAMES, 3))),
        r"track_points has shape \(2, 4, 3\), but \(5, 4, 3\) is expected",
    ),
    "truth intrinsics": (
        lambda r: rewrite_npz(r / "ground_truth.npz", intrinsics=np.zeros(4)), "positive focal lengths",
    ),
    "truth points without tracks": (lambda r: (r / "tracks.npz").unlink(), "there are no tracks"),
    "true depth count": (lambda r: (r / "depth_gt" / "frame_0006.png").unlink(), "depth_gt: has 3 frames"),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_gives_one_clear_error(tmp_path: Path, kind: str) -> None:
    root = native_folder(tmp_path)
    damage, message = DAMAGE[kind]
    damage(root)
    with pytest.raises(InputError, match=message) as raised:
        read_native(root)
    assert "\n" not in str(raised.value)
    assert str(root) in str(raised.value)
    report = validate_sequence(root, "native")
    assert not report.ok
    assert all(f.message and f.remedy for f in report.findings)


def test_depth_is_needed_to_read_a_sequence_but_may_be_made_later(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    shutil.rmtree(root / "depth_cue")
    with pytest.raises(InputError, match=r"has no depth: neither depth_cue/ nor depth_cue\.npy is there \(found"):
        read_native(root)
    report = validate_sequence(root)
    assert report.ok
    assert [(f.item, f.message.split(": ")[1]) for f in report.of("warning")] == [("depth", "has no depth")]
    assert not validate_sequence(root, depth="depth_cue").ok


def test_later_frames_are_checked_when_used(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    cut_file(root / "rgb" / "frame_0004.png")
    sequence = read_native(root)
    assert sequence.images[1].shape == (HEIGHT, WIDTH, 3)
    with pytest.raises(InputError, match=r"frame_0004\.png"):
        sequence.images[2]


def test_one_frame_is_too_few(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has 1 frame\(s\); give at least 2"):
        read_native(native_folder(tmp_path, frames=1))


def test_zero_bottom_rows_are_repaired_and_rounding_removed(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    expected = np.load(root / "c2w.npy")
    rounded = np.round(expected, 5)
    rounded[:, 3] = 0
    np.save(root / "c2w.npy", rounded)
    poses = read_native(root).ground_truth.world_T_cam
    assert poses is not None
    np.testing.assert_allclose(poses, expected, atol=2e-5)
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-14)


def test_missing_root(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_native(tmp_path / "absent")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        read_native(tmp_path / "file")


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    root = native_folder(tmp_path)
    with pytest.raises(OutputError, match="exists already"):
        write_native(sample_sequence(), root)
    (tmp_path / "empty").mkdir()
    write_native(sample_sequence(), tmp_path / "empty")
    assert is_native_layout(tmp_path / "empty")


@pytest.mark.parametrize("function", ["_write_masks", "_write_depth_array", "_write_native_tracks"])
def test_full_disk_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: str) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(write, function, full)
    with pytest.raises(OutputError) as raised:
        write_native(sample_sequence(far=True), tmp_path / "out")
    assert str(raised.value) == (
        f"cannot write {tmp_path / 'out'}: No space left on device; free space or choose another --out"
    )
    assert list(tmp_path.iterdir()) == []


def test_full_disk_names_the_file_where_it_would_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full)
    with pytest.raises(OutputError) as raised:
        write_native(sample_sequence(), tmp_path / "out")
    assert str(raised.value).startswith(f"cannot write {tmp_path / 'out' / 'K.npy'}: No space left")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("identity", [-1, 256**3])
def test_ids_that_do_not_fit(tmp_path: Path, identity: int) -> None:
    masks = ArrayFrames(np.full((FRAMES, HEIGHT, WIDTH), identity, np.int32))
    with pytest.raises(OutputError, match="use ids from 0 to 16777215"):
        write_native(dataclasses.replace(sample_sequence(), masks=masks), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("unknown", [np.nan, -np.inf])
def test_a_true_pose_may_be_unknown_and_a_pose_to_start_from_not(tmp_path: Path, unknown: float) -> None:
    root = native_folder(tmp_path)
    poses = np.load(root / "c2w.npy")
    poses[1] = unknown
    np.save(root / "c2w.npy", poses)
    found = read_native(root).ground_truth.world_T_cam
    assert found is not None
    np.testing.assert_array_equal(np.isnan(found).all(axis=(1, 2)), np.arange(FRAMES) == 1)
    np.testing.assert_allclose(found[[0, 2, 3]], poses[[0, 2, 3]], atol=1e-12)
    assert validate_sequence(root).ok
    np.save(root / "world_T_cam_init.npy", poses)
    with pytest.raises(InputError, match=r"world_T_cam_init\.npy: has NaN or infinite entries in frame\(s\) 1"):
        read_native(root)


def test_depth_in_a_unit_of_its_own_says_so_in_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "sequence"
    write_native(dataclasses.replace(sample_sequence(), depth_is_metric=False), folder)
    note = folder / "depth_cue.json"
    assert note.read_text() == '{"metric": false}\n'
    assert not read_native(folder).depth_is_metric
    note.write_text('{"metric": true}')
    assert read_native(folder).depth_is_metric
    for text in ("[]", "{}", '{"metric": 1}'):
        note.write_text(text)
        with pytest.raises(InputError, match=r"depth_cue\.json: does not say whether depth is in meters"):
            read_native(folder)
    note.unlink()
    assert read_native(folder).depth_is_metric


def test_the_note_is_of_the_usual_depth_alone(tmp_path: Path) -> None:
    folder = tmp_path / "sequence"
    write_native(dataclasses.replace(sample_sequence(), depth_is_metric=False), folder)
    shutil.copytree(folder / "depth_cue", folder / "other")
    assert read_native(folder, depth="other").depth_is_metric
