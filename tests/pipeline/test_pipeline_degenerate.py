"""Inputs that do not determine everything: a clear error, or a sound result of what they do determine."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import (
    SMALL,
    depth_of,
    make_config,
    make_scene,
    masks_of,
    run_sound,
    seen_only,
    temporary_files,
    with_depth,
    with_masks,
    with_true_poses,
)

from uni4d_fg.errors import DegenerateProblemError, InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.synthetic import CueNoise
from uni4d_fg.frontend.track_model import TrackLabel, Tracks
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.run_folder import RunFolder

pytest.importorskip("open3d")

FRAMES = SMALL["num_frames"]
FIXED = ("input.poses=fixed", "input.intrinsics=fixed")


@pytest.fixture(autouse=True)
def _no_runtime_warning() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        yield


@pytest.fixture(scope="module")
def scene() -> Sequence:
    return make_scene(SMALL)


def relative_ate(run_dir: Path, sequence: Sequence) -> float:
    trajectory = evaluate_run(run_dir, sequence).trajectory
    assert trajectory is not None
    return trajectory.ate_m / trajectory.path_length_reference_m


def assert_refused(sequence: Sequence, run_dir: Path, *texts: str) -> None:
    """Assert that estimating the cameras is refused in words, and that no result is written."""
    with pytest.raises(DegenerateProblemError) as caught:
        reconstruct(sequence, run_dir, make_config())
    for text in texts:
        assert text in str(caught.value)
    folder = RunFolder(run_dir)
    assert not any(path.exists() for path in (folder.reconstruction, folder.trajectory, folder.depth, folder.summary))
    assert temporary_files(run_dir) == []


def test_a_static_video_has_no_trajectories(tmp_path: Path) -> None:
    sequence = make_scene(SMALL, objects="none")
    summary, result = run_sound(sequence, tmp_path)
    assert len(result.dynamic_points) == 0
    assert len(result.landmarks) > 150
    assert summary.stages["nonrigid"]["facts"][-1] == "0 trajectories of 0 instances"
    assert relative_ate(tmp_path, sequence) < 0.05


def test_an_all_dynamic_video_does_not_determine_the_cameras(tmp_path: Path) -> None:
    sequence = make_scene(SMALL, objects="all_dynamic")
    assert_refused(sequence, tmp_path, "camera initialization", "0 static", "everything marked as moving")


def test_an_all_dynamic_video_with_known_cameras(tmp_path: Path) -> None:
    sequence = with_true_poses(make_scene(SMALL, objects="all_dynamic"))
    summary, result = run_sound(sequence, tmp_path, make_config(*FIXED))
    np.testing.assert_array_equal(result.world_T_cam, sequence.initial_world_T_cam)
    assert len(result.landmarks) == 0
    assert len(result.dynamic_points) > 100
    assert any("cameras kept as given" in text and "no static track" in text for text in summary.warnings)
    report = evaluate_run(tmp_path, sequence)
    assert report.depth is not None
    assert report.depth_cue is not None
    fused, cue = (d.metrics["scale"].regions["all"].abs_rel for d in (report.depth, report.depth_cue))
    assert fused is not None
    assert cue is not None
    assert fused < cue


@pytest.mark.parametrize("frames", [2, 3])
def test_very_short_videos(tmp_path: Path, frames: int) -> None:
    sequence = make_scene(SMALL, num_frames=frames)
    _, result = run_sound(sequence, tmp_path, make_config("input.intrinsics=fixed"))
    assert result.num_frames == frames
    assert len(result.landmarks) > 50
    assert len(result.dynamic_points) > 5
    truth = sequence.ground_truth.world_T_cam
    assert truth is not None
    # With hardly any parallax, a step along the axis is told from a change of the cue's scale by the prior alone.
    error = np.linalg.norm(result.world_T_cam[-1, :3, 3]) - np.linalg.norm(truth[-1, :3, 3] - truth[0, :3, 3])
    assert abs(error) < 0.1 * np.nanmedian(depth_of(sequence))


def test_two_frames_hardly_determine_the_focal_length(tmp_path: Path) -> None:
    summary, result = run_sound(make_scene(SMALL, num_frames=2), tmp_path)
    change = float(np.abs(result.intrinsics[:2] / (1.05 * SMALL["focal"]) - 1.0).max())
    assert (change > 0.15) == any("focal lengths moved" in text for text in summary.warnings)


def test_a_single_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has 1 frame\(s\); give at least 2"):
        reconstruct(make_scene(SMALL, num_frames=1), tmp_path, make_config())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", ["static", "rotation"])
def test_a_camera_that_does_not_travel(tmp_path: Path, path: str) -> None:
    sequence = make_scene(SMALL, path=path)
    summary, result = run_sound(sequence, tmp_path)
    assert any("the camera moves by only" in text for text in summary.warnings)
    assert np.linalg.norm(result.world_T_cam[:, :3, 3], axis=1).max() < 0.03
    truth = sequence.ground_truth.world_T_cam
    assert truth is not None
    relative = np.linalg.inv(truth[0]) @ truth[-1]
    error = result.world_T_cam[-1, :3, :3].T @ relative[:3, :3]
    assert np.degrees(np.arccos(np.clip((np.trace(error) - 1.0) / 2.0, -1.0, 1.0))) < 0.6


def test_exact_cues_of_a_camera_at_rest(tmp_path: Path) -> None:
    sequence = make_scene(SMALL, path="static", noise=CueNoise.none())
    _, result = run_sound(sequence, tmp_path)
    np.testing.assert_allclose(result.world_T_cam, np.tile(np.eye(4), (FRAMES, 1, 1)), atol=1e-4)
    np.testing.assert_allclose(result.intrinsics[:2], SMALL["focal"], rtol=1e-3)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_a_video_without_any_depth(tmp_path: Path, scene: Sequence, value: float) -> None:
    nothing = np.full_like(depth_of(scene), value)
    with pytest.raises(InputError, match="missing everywhere"):
        reconstruct(with_depth(scene, nothing), tmp_path / "estimate", make_config())
    assert not (tmp_path / "estimate").exists()
    corner = nothing.copy()
    corner[:, 0, 0] = 2.0
    assert_refused(with_depth(scene, corner), tmp_path / "corner", "0 static observations have depth", "depth")
    _, result = run_sound(with_depth(with_true_poses(scene), nothing), tmp_path / "fixed", make_config(*FIXED))
    assert len(result.landmarks) == len(result.dynamic_points) == 0


@pytest.mark.parametrize("missing", [slice(None, None, 2), slice(1, None, 2), slice(0, 4)])
def test_depth_missing_in_half_of_the_frames(tmp_path: Path, scene: Sequence, missing: slice) -> None:
    depth = depth_of(scene).copy()
    depth[missing] = np.nan
    sequence = with_depth(scene, depth)
    _, result = run_sound(sequence, tmp_path)
    assert relative_ate(tmp_path, sequence) < 0.05
    assert len(result.landmarks) > 150
    assert len(result.dynamic_points) > 20
    fused = read_depth(RunFolder(tmp_path).depth).array
    assert np.isnan(fused[missing]).all()
    report = evaluate_run(tmp_path, sequence).depth
    assert report is not None
    error = report.metrics["scale"].regions["all"].abs_rel
    assert error is not None
    assert error < 0.025


def test_depth_missing_on_all_moving_objects(tmp_path: Path, scene: Sequence) -> None:
    depth, masks = depth_of(scene).copy(), masks_of(scene)
    depth[masks > 0] = np.nan
    summary, result = run_sound(with_depth(scene, depth), tmp_path)
    assert len(result.dynamic_points) == 0
    assert summary.stages["nonrigid"]["dropped"]["dynamic track with too little depth"] > 20
    assert len(result.landmarks) > 150


def test_tracks_with_nan_are_refused_unless_not_visible(scene: Sequence) -> None:
    tracks = scene.tracks
    assert tracks is not None
    uv = tracks.uv.copy()
    uv[tuple(np.argwhere(tracks.visible)[0])] = np.nan
    with pytest.raises(InputError, match="a visible observation is NaN or infinite; mark it not visible"):
        Tracks(uv, tracks.visible, tracks.query_frame)


def test_a_sequence_with_an_empty_set_of_tracks(tmp_path: Path, scene: Sequence) -> None:
    none = Tracks(np.zeros((0, FRAMES, 2), np.float32), np.zeros((0, FRAMES), bool), np.zeros(0, np.int32))
    assert_refused(dataclasses.replace(scene, tracks=none), tmp_path / "estimate", "0 static", "tracks")
    known = dataclasses.replace(with_true_poses(scene), tracks=none)
    _, result = run_sound(known, tmp_path / "fixed", make_config(*FIXED, "fusion.averaged_offsets=[]"))
    assert len(result.landmarks) == len(result.dynamic_points) == 0
    np.testing.assert_allclose(read_depth(RunFolder(tmp_path / "fixed").depth).array, depth_of(scene), rtol=1e-6)


def test_images_in_which_nothing_can_be_tracked(tmp_path: Path, scene: Sequence) -> None:
    assert_refused(dataclasses.replace(scene, tracks=None), tmp_path, "0 static, 0 dynamic")


def test_tracks_that_are_all_outside_the_image(tmp_path: Path, scene: Sequence) -> None:
    tracks = scene.tracks
    assert tracks is not None
    for factor in (1e3, 1e30):
        moved = Tracks((tracks.uv + 1.0) * np.float32(factor), tracks.visible, tracks.query_frame)
        assert_refused(dataclasses.replace(scene, tracks=moved), tmp_path, "0 static, 0 dynamic")


def test_tracks_seen_in_one_frame_only(tmp_path: Path, scene: Sequence) -> None:
    tracks = scene.tracks
    assert tracks is not None
    assert_refused(seen_only(scene, np.arange(FRAMES) == tracks.query_frame[:, None]), tmp_path, "0 static")


@pytest.mark.parametrize("unseen", [0, 4, FRAMES - 1])
def test_a_frame_in_which_no_track_is_seen_is_bridged(tmp_path: Path, scene: Sequence, unseen: int) -> None:
    summary, result = run_sound(seen_only(scene, np.arange(FRAMES) != unseen), tmp_path)
    late = max(unseen, 1)
    assert summary.stages["camera_init"]["bridged_frames"] == [late]
    assert any("constant velocity" in text and text.endswith(f": {late}") for text in summary.warnings)
    truth = scene.ground_truth.world_T_cam
    assert truth is not None
    step = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).max()
    found = np.linalg.norm(np.diff(result.world_T_cam[:, :3, 3], axis=0), axis=1).max()
    assert found < 2.0 * step
    assert not result.dynamic_observed[:, unseen].any()


def test_a_gap_longer_than_the_window_is_bridged(tmp_path: Path) -> None:
    sequence = make_scene(SMALL, num_frames=20)
    hidden = (np.arange(20) >= 8) & (np.arange(20) < 14)
    summary, result = run_sound(seen_only(sequence, ~hidden), tmp_path)
    assert summary.stages["camera_init"]["bridged_frames"] == [8, 9, 10, 11, 12, 13, 14]
    assert len(result.landmarks) > 150


def test_thinning_does_not_make_a_frame_bridged(tmp_path: Path, scene: Sequence) -> None:
    summary, _ = run_sound(scene, tmp_path, make_config("camera_init.max_tracks_per_pair=6"))
    assert summary.stages["camera_init"]["bridged_frames"] == []


def test_an_instance_seen_in_one_frame_only(tmp_path: Path) -> None:
    static = make_scene(SMALL, objects="none")
    masks = masks_of(static).copy()
    masks[3, 30:70, 40:90] = 7
    summary, result = run_sound(with_masks(static, masks), tmp_path)
    assert len(result.dynamic_points) == 0
    assert len(result.landmarks) > 60
    assert summary.stages["tracks"]["tracks"]["rejected"] > 10


def test_a_track_seen_in_one_frame_of_an_instance_is_kept_when_asked_for(tmp_path: Path, scene: Sequence) -> None:
    tracks, truth = scene.tracks, scene.ground_truth
    assert tracks is not None
    assert truth.track_points is not None
    moving = np.ptp(truth.track_points, axis=1).max(axis=1) > 0.01
    first = np.arange(FRAMES) == tracks.query_frame[:, None]
    sequence = seen_only(scene, first | ~moving[:, None])
    _, result = run_sound(
        sequence, tmp_path, make_config("nonrigid.min_observations=1", "nonrigid.min_depth_observations=1")
    )
    assert (result.dynamic_observed.sum(axis=1) == 1).any()
    np.testing.assert_array_equal(np.isfinite(result.dynamic_points).all(axis=2), result.dynamic_observed)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_coinciding_tracks(tmp_path: Path, scene: Sequence, preset: str) -> None:
    tracks = scene.tracks
    assert tracks is not None
    some = np.arange(0, tracks.num_tracks, 5)
    twice = tracks.select(np.concatenate([some, some]))
    _, result = run_sound(dataclasses.replace(scene, tracks=twice), tmp_path, make_config(preset=preset))
    half = len(some)
    first = np.flatnonzero(result.dynamic_track < half)
    second = np.searchsorted(result.dynamic_track, result.dynamic_track[first] + half)
    assert len(first) > 5
    np.testing.assert_array_equal(result.dynamic_track[second], result.dynamic_track[first] + half)
    distance = np.linalg.norm(result.dynamic_points[first] - result.dynamic_points[second], axis=2)
    np.testing.assert_array_equal(np.isfinite(distance), np.isfinite(result.dynamic_points[first]).all(axis=2))
    if preset == "default":
        assert np.nanmax(distance) < 0.02


def test_instances_that_appear_and_vanish(tmp_path: Path, scene: Sequence) -> None:
    masks = masks_of(scene).copy()
    ids = np.unique(masks[masks > 0])
    assert len(ids) == 2
    masks[:4][masks[:4] == ids[0]] = 0
    masks[4:][masks[4:] == ids[1]] = 0
    run_sound(with_masks(scene, masks), tmp_path)
    labelled = load_labels(RunFolder(tmp_path).labels)
    assert (labelled.label == TrackLabel.REJECTED).sum() > 20


def test_an_instance_that_changes_its_id_is_never_linked_across(tmp_path: Path, scene: Sequence) -> None:
    masks = masks_of(scene).copy()
    masks[4:][masks[4:] > 0] += 100
    tracks = scene.tracks
    assert tracks is not None
    own_half = (np.arange(FRAMES) < 4) == (tracks.query_frame < 4)[:, None]
    _, result = run_sound(with_masks(seen_only(scene, own_half), masks), tmp_path)
    early = result.dynamic_observed[:, :4].any(axis=1)
    late = result.dynamic_observed[:, 4:].any(axis=1)
    assert early.any()
    assert late.any()
    assert not (early & late).any()
    np.testing.assert_array_equal(result.dynamic_instance > 100, late)


def test_huge_instance_ids(tmp_path: Path, scene: Sequence) -> None:
    masks = np.where(masks_of(scene) > 0, 2**31 - 1, 0)
    _, result = run_sound(with_masks(scene, masks), tmp_path)
    assert (result.dynamic_instance == 2**31 - 1).all()
    assert len(result.dynamic_points) > 20


def test_irregular_timestamps_are_kept(tmp_path: Path, scene: Sequence, rng: np.random.Generator) -> None:
    times = 1.6e9 + np.cumsum(rng.exponential(size=FRAMES) + 1e-3)
    _, result = run_sound(dataclasses.replace(scene, timestamps=times), tmp_path)
    np.testing.assert_array_equal(result.timestamps, times)


def test_outlier_rules_that_leave_nothing_say_which(tmp_path: Path, scene: Sequence) -> None:
    for override, text in (
        ("bundle_adjustment.max_reprojection_px=0.001", "observation with a large reprojection error"),
        ("bundle_adjustment.max_depth_ratio=1.00001", "landmark whose depth contradicts the cue"),
        ("bundle_adjustment.outlier_factor=0.001", "raise outlier_factor or outlier_quantile"),
    ):
        with pytest.raises(DegenerateProblemError, match=text):
            reconstruct(scene, tmp_path, make_config(override))


def test_given_poses_must_be_there(tmp_path: Path, scene: Sequence) -> None:
    with pytest.raises(InputError, match=r"input\.poses is 'initial' but synthetic brings no poses; add world_T_cam"):
        reconstruct(scene, tmp_path, make_config("input.poses=initial"))


def broken_parts(scene: Sequence) -> dict[str, tuple[dict[str, object], str]]:
    poses, times = scene.ground_truth.world_T_cam, scene.timestamps
    assert poses is not None
    lost, sheared, mirrored = poses.copy(), poses.copy(), poses.copy()
    lost[3, 0, 3], sheared[5, 0, 1] = np.nan, sheared[5, 0, 1] + 1e-3
    mirrored[:, :3, 0] *= -1.0
    gray = np.zeros((FRAMES, 90, 128, 3), np.uint8)
    return {
        "few poses": ({"initial_world_T_cam": poses[:4]}, rf"has shape \(4, 4, 4\); give \({FRAMES}, 4, 4\)"),
        "lost pose": ({"initial_world_T_cam": lost}, r"not a rigid transform in frame\(s\) 3;"),
        "sheared pose": ({"initial_world_T_cam": sheared}, r"not a rigid transform in frame\(s\) 5;"),
        "mirrored poses": ({"initial_world_T_cam": mirrored}, r"frame\(s\) 0, 1, 2, 3, 4 and 3 more"),
        "no focal length": ({"intrinsics": np.zeros(4)}, "positive focal lengths"),
        "NaN intrinsics": ({"intrinsics": np.full(4, np.nan)}, "positive focal lengths"),
        "time stands still": ({"timestamps": 0.0 * times}, "strictly increasing"),
        "too few times": ({"timestamps": times[:4]}, "one strictly increasing number of seconds per frame"),
        "short zoom": ({"zoom": np.ones(3)}, "zoom that is not 8 numbers above 0 and at most 1"),
        "lost zoom": ({"zoom": np.full(FRAMES, np.nan)}, "zoom that is not 8 numbers above 0 and at most 1"),
        "too few depth maps": ({"depths": ArrayFrames(depth_of(scene)[:5])}, "has 5 depth maps, but there are 8"),
        "too few masks": ({"masks": ArrayFrames(masks_of(scene)[:5])}, "has 5 masks, but there are 8 images"),
        "small images": ({"images": ArrayFrames(gray)}, r"image of frame 0 has shape \(90, 128, 3\)"),
        "small depth": ({"depths": ArrayFrames(depth_of(scene)[:, :90])}, r"depth of frame 0 has shape \(90, 128\)"),
    }  # fmt: skip


def test_parts_that_contradict_each_other_are_refused(tmp_path: Path, scene: Sequence) -> None:
    posed = dataclasses.replace(scene, initial_world_T_cam=scene.ground_truth.world_T_cam)
    for name, (changes, text) in broken_parts(scene).items():
        sequence = dataclasses.replace(posed, **changes)  # type: ignore[arg-type]
        with pytest.raises(InputError, match=text):
            reconstruct(sequence, tmp_path / name, make_config("input.poses=fixed"))
