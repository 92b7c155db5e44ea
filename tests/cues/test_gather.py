"""Gathering cues: what is made, what is kept on disk, what is said, and what happens when it is interrupted."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_networks import moving_points, two_classes, weighted_channels, write_card

from uni4d_fg.arrays import ImageArray
from uni4d_fg.config.load import load_config
from uni4d_fg.cues import cache as cue_cache
from uni4d_fg.cues.cache import FrameCache, Rate, image_key, write_labels
from uni4d_fg.cues.depth_network import DepthNetwork
from uni4d_fg.cues.gather import gather_cues, static_tracks
from uni4d_fg.cues.manifest import has_manifest, load_cues
from uni4d_fg.cues.packed_maps import RELATIVE_ERROR, rounded
from uni4d_fg.cues.plan import CueFiles, CuePlan, plan_cues
from uni4d_fg.cues.scale_notes import NOT_METRIC, NOT_METRIC_RELATIVE
from uni4d_fg.errors import Cancelled, ConfigError, InputError, OutputError
from uni4d_fg.files import save_npy, save_npz
from uni4d_fg.frontend.sequence.decode import read_mask
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence, Video
from uni4d_fg.frontend.track_model import Tracks

CONFIG = load_config("fast", ["networks.threads=1", "tracking.grid_columns=12", "tracking.grid_rows=10"])
SIZE = (40, 56)
T = 6


def noise_video(**cues: Any) -> Video:
    images = np.random.default_rng(3).integers(0, 256, (T, *SIZE, 3), dtype=np.uint8)
    return Video("noise", ArrayFrames(images), SIZE, np.arange(T, dtype=float), **cues)


@pytest.fixture
def depth_card(tmp_path: Path) -> str:
    weighted_channels(tmp_path / "tiny.onnx", (3.0, 0, 0), 1.0, extra={"camera": [50.0]})
    return str(write_card(tmp_path / "depth.yaml", intrinsics={"name": "camera", "kind": "focal_px"}))


def card_plan(video: Video, card: str, **more: Any) -> CuePlan:
    return plan_cues(video, bare=False, depth_model=card, **more)


def test_what_is_given_is_left_alone_and_nothing_is_written(tmp_path: Path) -> None:
    depths = ArrayFrames(np.full((T, *SIZE), 2.0, np.float32))
    video = noise_video(depths=depths)
    plan = plan_cues(video, bare=False)
    assert plan.is_given
    sequence, report = gather_cues(video, plan, tmp_path / "cues", CONFIG)
    assert sequence.depths is depths
    assert not any(mask.any() for mask in sequence.masks)
    assert (sequence.tracks, report.metric, report.warnings) == (None, True, [])
    assert not (tmp_path / "cues").exists()


@pytest.mark.parametrize(
    ("given", "options", "expected"),
    [
        (set(), {"bare": True}, ("geometry", "motion", "built_in")),
        ({"depths"}, {"bare": True}, ("given", "motion", "built_in")),
        ({"depths"}, {"bare": False}, ("given", "none", "built_in")),
        ({"depths", "masks"}, {"bare": False}, ("given", "given", "built_in")),
        ({"masks"}, {"bare": True}, ("geometry", "given", "built_in")),
        ({"depths", "masks"}, {"bare": False, "masks": "motion"}, ("given", "motion", "built_in")),
        ({"depths", "masks"}, {"bare": False, "masks": "none"}, ("given", "none", "built_in")),
        ({"depths", "masks"}, {"bare": False, "mask_model": "x"}, ("given", "card", "built_in")),
        ({"depths", "tracks"}, {"bare": False, "depth_model": "x"}, ("card", "none", "given")),
        ({"depths", "tracks"}, {"bare": False, "track_model": "x"}, ("given", "none", "card")),
    ],
)
def test_the_plan(given: set[str], options: Any, expected: tuple[str, str, str]) -> None:
    tracks = Tracks(np.zeros((1, T, 2), np.float32), np.ones((1, T), bool), np.zeros(1, np.int32))
    maps = ArrayFrames(np.ones((T, *SIZE), np.float32))
    values = {"depths": maps, "masks": maps, "tracks": tracks}
    plan = plan_cues(noise_video(**{name: values[name] for name in given}), **options)
    assert (plan.depth, plan.masks, plan.tracks) == expected


def test_depth_of_a_card_with_its_camera(tmp_path: Path, depth_card: str) -> None:
    video = noise_video()
    sequence, report = gather_cues(video, card_plan(video, depth_card, masks="none"), tmp_path / "cues", CONFIG)
    for image, depth in zip(video.images, sequence.depths, strict=True):
        np.testing.assert_allclose(depth, image[..., 0] / 85 + 1, rtol=1.05 * RELATIVE_ERROR)
    np.testing.assert_allclose(sequence.intrinsics, [50, 50, 27.5, 19.5])
    assert report.metric
    assert report.sources == {"depth": "tiny", "masks": "none, everything is static", "tracks": "built-in tracker",
                              "intrinsics": "tiny"}  # fmt: skip
    known = np.array([70.0, 70.0, 27.0, 19.0])
    video = noise_video(intrinsics=known)
    sequence, _ = gather_cues(video, card_plan(video, depth_card, masks="none"), tmp_path / "cues", CONFIG)
    np.testing.assert_array_equal(sequence.intrinsics, known)


def test_cues_can_be_opened_again_without_the_network(tmp_path: Path, depth_card: str) -> None:
    video = noise_video()
    folder = tmp_path / "run" / "cues"
    made, report = gather_cues(video, card_plan(video, depth_card, masks="none"), folder, CONFIG)
    (tmp_path / "tiny.onnx").unlink()
    moved = folder.parent.rename(tmp_path / "moved") / "cues"
    opened, said = load_cues(video, moved)
    np.testing.assert_array_equal(opened.depths[3], rounded(made_depth(video, 3)))
    np.testing.assert_array_equal(opened.intrinsics, made.intrinsics)
    assert said == report
    shutil.rmtree(moved / "depth")
    with pytest.raises(InputError, match=r"no longer there.*--resume"):
        load_cues(video, moved)
    short = replace(video, images=ArrayFrames(np.zeros((3, *SIZE, 3), np.uint8)))
    with pytest.raises(InputError, match="was the video replaced"):
        load_cues(short, moved)
    (moved / "cues.json").write_text("{")
    with pytest.raises(InputError, match=r"cues\.json"):
        load_cues(video, moved)


def made_depth(video: Video, frame: int) -> np.ndarray:
    return (3 * (video.images[frame][..., 0] * np.float32(1 / 255)) + 1).astype(np.float32)


class CountingNetwork:
    """Counts the frames that go through a network."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.frames = 0
        original = DepthNetwork.estimate

        def estimate(network: DepthNetwork, image: ImageArray, focal_px: float) -> Any:
            self.frames += 1
            return original(network, image, focal_px)

        monkeypatch.setattr(DepthNetwork, "estimate", estimate)


def test_ctrl_c_loses_the_frame_in_work_at_most(
    tmp_path: Path, depth_card: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = CountingNetwork(monkeypatch)
    video = noise_video()
    plan = card_plan(video, depth_card, masks="none")
    answers = iter([False] * 3 + [True])
    with pytest.raises(Cancelled, match="3 of 6 frames"):
        gather_cues(video, plan, tmp_path / "cues", CONFIG, should_stop=lambda: next(answers))
    assert not has_manifest(tmp_path / "cues")
    gather_cues(video, plan, tmp_path / "cues", CONFIG)
    assert counted.frames == T
    gather_cues(video, plan, tmp_path / "cues", CONFIG)
    assert counted.frames == T


def test_the_cache_goes_by_content_and_card(tmp_path: Path, depth_card: str, monkeypatch: pytest.MonkeyPatch) -> None:
    counted = CountingNetwork(monkeypatch)
    video = noise_video()
    images = np.stack(list(video.images))
    plan = card_plan(video, depth_card, masks="none")
    gather_cues(video, plan, tmp_path / "cues", CONFIG)
    shuffled = replace(video, images=ArrayFrames(images[::-1]))
    gather_cues(shuffled, plan, tmp_path / "cues", CONFIG)
    assert counted.frames == T
    changed = images.copy()
    changed[2, 0, 0, 0] ^= 1
    gather_cues(replace(video, images=ArrayFrames(changed)), plan, tmp_path / "cues", CONFIG)
    assert counted.frames == T + 1
    weighted_channels(tmp_path / "tiny.onnx", (4.0, 0, 0), 1.0, extra={"camera": [50.0]})
    sequence, _ = gather_cues(video, plan, tmp_path / "cues", CONFIG)
    assert counted.frames == 2 * T + 1
    np.testing.assert_allclose(sequence.depths[0], 4 * (images[0, ..., 0] / 255) + 1, rtol=1.05 * RELATIVE_ERROR)


def test_a_damaged_file_of_the_cache_is_made_again(
    tmp_path: Path, depth_card: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = noise_video()
    plan = card_plan(video, depth_card, masks="none")
    gather_cues(video, plan, tmp_path / "cues", CONFIG)
    path = next(p for p in (tmp_path / "cues" / "depth").rglob("*.map.npz"))
    path.write_bytes(path.read_bytes()[:100])
    counted = CountingNetwork(monkeypatch)
    sequence, _ = gather_cues(video, plan, tmp_path / "cues", CONFIG)
    assert counted.frames == 1
    assert all(np.isfinite(depth).all() for depth in sequence.depths)


def test_a_full_disk_is_one_error_and_what_was_done_is_kept(
    tmp_path: Path, depth_card: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = noise_video()
    plan = card_plan(video, depth_card, masks="none")
    saved, original = 0, np.lib.format.write_array

    def write(stream: Any, array: Any, **options: Any) -> None:
        nonlocal saved
        saved += 1
        if saved == 5:
            stream.write(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        original(stream, array, **options)

    monkeypatch.setattr(np.lib.format, "write_array", write)
    with pytest.raises(OutputError, match="No space left on device; free space"):
        gather_cues(video, plan, tmp_path / "cues", CONFIG)
    assert not has_manifest(tmp_path / "cues")
    assert not list((tmp_path / "cues").rglob(".tmp-*"))
    monkeypatch.undo()
    counted = CountingNetwork(monkeypatch)
    gather_cues(video, plan, tmp_path / "cues", CONFIG)
    assert 0 < counted.frames < T


def test_instances_of_a_segmenter_keep_their_number(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(0, 40, (T, *SIZE, 3), dtype=np.uint8)
    for frame in range(T):
        images[frame, 4:14, 3 + 2 * frame : 13 + 2 * frame, 0] = 255
        images[frame, 24:36, 40 - 2 * frame : 52 - 2 * frame, 0] = 255
    two_classes(tmp_path / "tiny.onnx")
    card = write_card(
        tmp_path / "people.yaml", kind="segmentation", classes=["background", "person"],
        outputs={"format": "semantic", "scores": "scores", "activation": "softmax"},
    )  # fmt: skip
    video = Video(
        "two", ArrayFrames(images), SIZE, np.arange(T, dtype=float), depths=ArrayFrames(np.ones((T, *SIZE), np.float32))
    )
    plan = plan_cues(video, bare=False, mask_model=str(card))
    sequence, report = gather_cues(video, plan, tmp_path / "cues", CONFIG)
    upper = {int(mask[9, 8 + 2 * frame]) for frame, mask in enumerate(sequence.masks)}
    lower = {int(mask[30, 46 - 2 * frame]) for frame, mask in enumerate(sequence.masks)}
    assert len(upper) == len(lower) == 1
    assert not upper & lower
    assert 0 not in upper | lower
    assert "2 instances" in report.facts[0]
    again, _ = gather_cues(video, plan, tmp_path / "cues", CONFIG)
    np.testing.assert_array_equal(again.masks[2], sequence.masks[2])
    with pytest.raises(InputError, match="no class is called 'cat'"):
        gather_cues(video, replace(plan, classes=("cat",)), tmp_path / "cues", CONFIG)


def test_tracks_of_a_card_are_kept_and_opened_again(tmp_path: Path) -> None:
    levels = np.arange(T, dtype=np.uint8)
    images = np.broadcast_to(levels[:, None, None, None], (T, *SIZE, 3))
    moving_points(tmp_path / "tiny.onnx", 4, 20, (20, 28), (0.5, 0.0))
    card = write_card(
        tmp_path / "points.yaml", kind="tracks", input={"name": "video", "scale": 1.0}, overlap=2,
        size={"rule": "fixed", "height": 20, "width": 28},
        video={"frames": 4, "points": 20, "queries": "queries", "query_order": "txy"},
        outputs={"tracks": "tracks", "order": "TN", "visibility": "visibility", "visibility_kind": "logit"},
    )  # fmt: skip
    depths = ArrayFrames(np.ones((T, *SIZE), np.float32))
    video = Video("moving", ArrayFrames(images), SIZE, np.arange(T, dtype=float), depths=depths)
    plan = plan_cues(video, bare=False, track_model=str(card))
    sequence, report = gather_cues(video, plan, tmp_path / "cues", CONFIG)
    assert sequence.tracks is not None
    assert sequence.tracks.num_tracks > 1000
    assert report.sources["tracks"] == "tiny"
    assert not any(path.is_dir() for path in (tmp_path / "cues" / "tracks").iterdir())
    opened, _ = load_cues(video, tmp_path / "cues")
    assert opened.tracks is not None
    np.testing.assert_array_equal(opened.tracks.uv, sequence.tracks.uv)


def test_a_plan_for_a_cue_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="depth are to be taken as given"):
        gather_cues(noise_video(), CuePlan(masks="none"), tmp_path / "cues", CONFIG)


def test_cues_in_files_of_their_own(tmp_path: Path) -> None:
    video = noise_video()
    save_npy(tmp_path / "depth.npy", np.full((T, *SIZE), 3.0, np.float32))
    save_npy(tmp_path / "K.npy", np.array([[80.0, 0, 28], [0, 80, 20], [0, 0, 1]]))
    save_npz(tmp_path / "tracks.npz", pred_tracks=np.ones((1, T, 3, 2)), pred_visibility=np.ones((1, T, 3), bool))
    for frame in range(T):
        write_labels(tmp_path / "masks" / f"{frame:05d}.png", np.full(SIZE, 7, np.int32))
    files = CueFiles(tmp_path / "depth.npy", tmp_path / "masks", tmp_path / "tracks.npz", tmp_path / "K.npy")
    whole = files.attach(video)
    assert whole.depths is not None
    assert whole.masks is not None
    assert whole.tracks is not None
    assert whole.intrinsics is not None
    assert float(whole.depths[0][0, 0]) == 3.0
    assert int(whole.masks[0][0, 0]) == 7
    assert (whole.tracks.num_tracks, whole.intrinsics[0]) == (3, 80.0)
    found = replace(video, masks_from_motion=True)  # those that it brought were; these are given
    assert not files.attach(found).masks_from_motion
    assert CueFiles(depth=files.depth).attach(found).masks_from_motion
    poses = np.tile(np.eye(4), (T, 1, 1))
    own = replace(
        video, depth_is_metric=False, depth_parallax=True, focal_sigma=0.1, initial_world_T_cam=poses
    )  # what that depth and those intrinsics were is not what these are
    with_depth, with_intrinsics = (
        CueFiles(depth=files.depth).attach(own),
        CueFiles(intrinsics=files.intrinsics).attach(own),
    )
    assert (with_depth.depth_is_metric, with_depth.depth_parallax, with_depth.focal_sigma) == (True, None, 0.1)
    assert with_depth.initial_world_T_cam is None
    assert (with_intrinsics.depth_is_metric, with_intrinsics.depth_parallax) == (False, True)
    assert with_intrinsics.focal_sigma is None
    assert with_intrinsics.initial_world_T_cam is poses
    assert CueFiles(depth=files.depth).attach(replace(own, depth_is_metric=True)).initial_world_T_cam is poses
    for name in ("depth", "masks", "tracks", "intrinsics"):
        with pytest.raises(InputError, match="nosuch"):
            CueFiles(**{name: tmp_path / "nosuch"}).attach(video)
    short = replace(video, images=ArrayFrames(np.zeros((4, *SIZE, 3), np.uint8)))
    for cue in (CueFiles(depth=files.depth), CueFiles(tracks=files.tracks)):
        with pytest.raises(InputError, match="6"):
            cue.attach(short)


def test_tracks_on_masks_are_not_static() -> None:
    uv = np.array([[[5, 5], [6, 5]], [[20, 20], [21, 20]], [[20, 20], [5, 5]]], np.float32)
    visible = np.array([[True, True], [True, True], [True, False]])
    masks = np.zeros((2, 30, 30), np.int32)
    masks[1, 4:7, 4:8] = 3
    static = static_tracks(Tracks(uv, visible, np.zeros(3, np.int32)), ArrayFrames(masks))
    assert static.tolist() == [False, True, True]


@pytest.mark.parametrize("largest", [200, 70_000])
def test_labels_are_read_back(tmp_path: Path, largest: int) -> None:
    labels = np.array([[0, 1], [largest, 2]], np.int32)
    write_labels(tmp_path / "a.png", labels)
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), labels)
    with pytest.raises(OutputError):
        write_labels(tmp_path / "b.png", -labels)
    assert not (tmp_path / "b.png").exists()


def test_keys_change_with_every_pixel_and_version(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    changed = image.copy()
    changed[3, 3, 2] = 1
    assert len({image_key(image), image_key(changed), image_key(image[:2])}) == 3
    before = cue_cache.maker_key("a", 1)
    monkeypatch.setattr(cue_cache, "CACHE_VERSION", 99)
    assert cue_cache.maker_key("a", 1) != before


def test_progress_says_rate_and_time_left() -> None:
    now = iter([0.0, 2.0, 4.0, 4.0])
    rate = Rate(10, lambda: next(now))
    assert rate.text(1, True) == "0.5 frames/s, 0:18 left"
    assert rate.text(2, True) == "0.5 frames/s, 0:16 left"
    assert Rate(10, lambda: 0.0).text(3, False) == "3 of 10"


def test_detections_survive_the_cache(tmp_path: Path) -> None:
    from uni4d_fg.cues.detections import FrameDetections

    cache = FrameCache(tmp_path)
    masks = np.random.default_rng(0).random((3, 7, 9)) > 0.5
    found = FrameDetections(masks, np.array([4, 0, 2], np.int32), np.array([0.5, 0.25, 1], np.float32))
    cache.put_detections("x", found)
    back = cache.detections("x", (7, 9))
    assert back is not None
    np.testing.assert_array_equal(back.masks, masks)
    np.testing.assert_array_equal(back.class_ids, found.class_ids)
    assert cache.detections("y", (7, 9)) is None
    cache.put_detections("none", FrameDetections.none((7, 9)))
    empty = cache.detections("none", (7, 9))
    assert empty is not None
    assert len(empty) == 0


ROOM_CONFIG = load_config("fast", ["input.intrinsics=fixed", "tracking.grid_columns=24", "tracking.grid_rows=18"])


@pytest.fixture(scope="module")
def room() -> Video:
    """Frames of a static scene with its truth, and a calibration."""
    pytest.importorskip("open3d")
    from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence

    config = SyntheticSceneConfig(num_frames=10, width=160, height=120, focal=150.0, objects="none", frame_rate=5.0)
    scene = make_synthetic_sequence(config)
    truth = scene.ground_truth
    return Video(
        scene.name, scene.images, scene.image_size, scene.timestamps, intrinsics=truth.intrinsics, ground_truth=truth
    )


def error_up_to_scale(sequence: Sequence, video: Video) -> float:
    assert video.ground_truth.depths is not None
    ratio = np.stack(list(sequence.depths)) / np.stack(list(video.ground_truth.depths))
    return float(np.nanmedian(np.abs(ratio / np.nanmedian(ratio) - 1)))


def test_without_any_cue_depth_comes_from_motion_and_is_called_not_metric(tmp_path: Path, room: Video) -> None:
    video = room
    plan = plan_cues(video, bare=True, masks="none")
    sequence, report = gather_cues(video, plan, tmp_path / "cues", ROOM_CONFIG)
    assert not report.metric
    assert report.warnings[0] == NOT_METRIC
    assert sequence.depth_parallax
    assert not sequence.masks_from_motion
    assert sequence.initial_world_T_cam is not None
    assert all(np.isfinite(depth).all() for depth in sequence.depths)
    assert error_up_to_scale(sequence, video) < 0.04
    stored = json.loads((tmp_path / "cues" / "cues.json").read_text())
    assert stored["report"]["metric"] is False
    opened, _ = load_cues(video, tmp_path / "cues")
    assert opened.initial_world_T_cam is not None
    np.testing.assert_allclose(opened.initial_world_T_cam, sequence.initial_world_T_cam)
    np.testing.assert_array_equal(opened.depths[4], sequence.depths[4])
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "cues" / "depth").rglob("*.npz")}
    gather_cues(video, plan, tmp_path / "cues", ROOM_CONFIG)
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "cues" / "depth").rglob("*.npz")}


def test_relative_depth_is_brought_to_the_scale_of_the_motion(tmp_path: Path, room: Video) -> None:
    video = room
    truth = video.ground_truth.depths
    assert truth is not None
    # The image is replaced by its disparity in the red channel's place: the network "sees" it, the tracker does too.
    images = np.stack(list(video.images))
    relative = np.stack([np.asarray(1.0 / depth) for depth in truth])
    low, high = np.nanmin(relative), np.nanmax(relative)
    images[..., 0] = np.rint(255 * (np.nan_to_num(relative, nan=low) - low) / (high - low))
    video = replace(video, images=ArrayFrames(images))
    weighted_channels(tmp_path / "tiny.onnx", (5.0, 0, 0), -2.0)
    card = write_card(tmp_path / "relative.yaml", depth={"kind": "affine_disparity"})
    plan = plan_cues(video, bare=True, masks="none", depth_model=str(card))
    sequence, report = gather_cues(video, plan, tmp_path / "cues", ROOM_CONFIG)
    assert (report.metric, report.warnings[0]) == (False, NOT_METRIC_RELATIVE)
    assert error_up_to_scale(sequence, video) < 0.04
