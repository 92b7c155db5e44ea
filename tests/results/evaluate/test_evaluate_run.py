"""A run folder with known errors gets known scores, and absent truth is named."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Sequence
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.geometry import se3
from uni4d_fg.results.depth_store import write_depth
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.evaluate.table import format_report
from uni4d_fg.results.io import save_reconstruction
from uni4d_fg.results.labels_io import save_labels
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

FRAMES, TRACKS, SIZE = 6, 10, (8, 10)
STATIC, MOVING = np.arange(6, dtype=np.int32), np.arange(6, 10, dtype=np.int32)


def make_tracks() -> Tracks:
    return Tracks(
        np.zeros((TRACKS, FRAMES, 2), np.float32),
        np.ones((TRACKS, FRAMES), bool),
        np.arange(TRACKS, dtype=np.int32) % 3,
    )


@pytest.fixture
def truth_and_run(tmp_path: Path) -> tuple[Sequence, Reconstruction, Path]:
    """A sequence, and a reconstruction of it that is exact but for its gauge and scale, in a folder."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.random(FRAMES, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(FRAMES, 3))
    points = np.repeat(rng.normal(size=(TRACKS, 1, 3)), FRAMES, axis=1)
    points[6:] += rng.normal(size=(4, FRAMES, 3))
    depth = (rng.random((FRAMES, *SIZE)) + 1.0).astype(np.float32)
    masks = np.zeros((FRAMES, *SIZE), np.int32)
    masks[:, :, 5:] = 2
    sequence = Sequence(
        name="made up",
        images=ArrayFrames(np.zeros((FRAMES, *SIZE, 3), np.uint8)),
        depths=ArrayFrames(depth * np.float32(0.5)),
        masks=ArrayFrames(masks),
        intrinsics=np.array([10.0, 10, 5, 4]),
        image_size=SIZE,
        timestamps=np.arange(FRAMES) * 1.0,
        tracks=make_tracks(),
        ground_truth=GroundTruth(
            world_T_cam=poses,
            depths=ArrayFrames(depth),
            intrinsics=np.array([10.0, 10, 5, 4]),
            track_points=points,
        ),
    )
    # The estimate lives in a world that is turned, moved and half the size.
    turn = Rotation.from_euler("xyz", [0.3, -0.5, 1.0]).as_matrix()
    estimated = poses.copy()
    estimated[:, :3, :3] = turn @ poses[:, :3, :3]
    estimated[:, :3, 3] = 0.5 * poses[:, :3, 3] @ turn.T + 1.0
    moved = 0.5 * points @ turn.T + 1.0
    observed = np.ones((4, FRAMES), bool)
    observed[:, 3] = False
    reconstruction = Reconstruction(
        world_T_cam=estimated,
        intrinsics=sequence.intrinsics,
        timestamps=sequence.timestamps,
        image_size=SIZE,
        depth_log_scale=np.zeros(FRAMES),
        landmarks=moved[STATIC, 0],
        landmark_track=STATIC,
        landmark_color=np.zeros((6, 3), np.uint8),
        landmark_error=np.zeros(6, np.float32),
        dynamic_points=moved[MOVING],
        dynamic_observed=observed,
        dynamic_track=MOVING,
        dynamic_instance=np.full(4, 2, np.int32),
        dynamic_color=np.zeros((4, 3), np.uint8),
    )
    folder = RunFolder(tmp_path / "run")
    save_reconstruction(folder.reconstruction, reconstruction)
    with write_depth(folder.depth, FRAMES, SIZE) as writer:
        for frame in range(FRAMES):
            writer.write(frame, depth[frame] * 1.1)
    return sequence, reconstruction, folder.root


def test_covariances_are_compared_with_the_errors(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, reconstruction, root = truth_and_run
    file = RunFolder(root).reconstruction
    assert evaluate_run(root, sequence).consistency is None
    # The run's lengths are wrong by a factor: by the metric its poses err, with the scale as a gauge they are exact.
    save_reconstruction(
        file, dataclasses.replace(reconstruction, pose_covariance=np.tile(1e-6 * np.eye(6), (FRAMES, 1, 1)))
    )
    report = evaluate_run(root, sequence)
    assert report.consistency is not None
    metric, scaled = report.consistency
    assert metric.mean > 100.0
    assert scaled.mean < 1e-3
    assert scaled.within_95 == 1.0
    assert report.trajectory is not None
    assert scaled.scale == pytest.approx(report.trajectory.scale, rel=1e-4)
    text = format_report(report)
    assert "Covariances of the cameras" in text
    assert "100 % / 100 %" in text
    unknown = dataclasses.replace(reconstruction, pose_covariance=np.full((FRAMES, 6, 6), np.nan))
    save_reconstruction(file, unknown)
    assert evaluate_run(root, sequence).missing["consistency"] == "the run's covariances are not determined"


def test_an_exact_run_scores_zero(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, _, root = truth_and_run
    report = evaluate_run(root, sequence)
    assert report.missing == {}
    assert report.trajectory is not None
    assert report.trajectory.ate_m == pytest.approx(0.0, abs=1e-9)
    assert report.trajectory.scale == pytest.approx(2.0)
    assert report.depth is not None
    assert report.depth.metrics["metric"].regions["all"].abs_rel == pytest.approx(0.1, abs=1e-5)
    assert report.depth.metrics["scale"].regions["instance 2"].abs_rel == pytest.approx(0.0, abs=2e-5)
    assert report.depth_cue is not None
    assert report.depth_cue.metrics["metric"].regions["static"].abs_rel == pytest.approx(0.5, abs=1e-5)
    assert report.landmarks is not None
    assert report.landmarks[0].rmse_m == pytest.approx(0.0, abs=1e-9)
    assert report.landmarks[1].rmse_m > 0.1  # a rigid map cannot undo the scale
    assert report.dynamic_points is not None
    by_protocol = {metrics.protocol: metrics for metrics in report.dynamic_points}
    observed = by_protocol["observed, aligned by Sim(3) Umeyama of the cameras, RMSE"]
    bridged = by_protocol["bridged, aligned by Sim(3) Umeyama of the cameras, RMSE"]
    assert observed.rmse_m == pytest.approx(0.0, abs=1e-9)
    assert (observed.points, bridged.points) == (20, 4)
    json.dumps(report.to_dict(), allow_nan=False)


def test_table_names_numbers_and_protocols(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, _, root = truth_and_run
    text = format_report(evaluate_run(root, sequence))
    assert "Sim(3) Umeyama, RMSE, RPE delta 1 frame, all pairs" in text
    assert "ATE" in text
    assert "instance 2" in text
    assert "20 (0 without estimate, 0 without truth)" in text
    assert max(map(len, text.splitlines())) < 160


def test_absent_truth_is_named_not_left_out(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, _, root = truth_and_run
    report = evaluate_run(root, dataclasses.replace(sequence, ground_truth=GroundTruth()))
    parts = ("trajectory", "depth", "depth_cue", "landmarks", "dynamic_points")
    assert report.missing == dict.fromkeys(parts, "no ground truth")
    for part in parts:
        assert report.to_dict()[part] == {"missing": "no ground truth"}
    assert format_report(report).count("no ground truth") == 5


def test_unknown_true_poses_are_left_out_and_counted(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, _, root = truth_and_run
    poses = sequence.ground_truth.world_T_cam
    assert poses is not None
    poses[0] = np.nan
    report = evaluate_run(root, sequence)
    assert report.poses_without_truth == 1
    assert report.trajectory is not None
    assert report.trajectory.poses == 5
    assert "frames without a true pose" in format_report(report)
    poses[:] = np.nan
    assert "every true pose is unknown" in evaluate_run(root, sequence).missing["trajectory"]


def test_a_run_without_depth_says_so(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, _, root = truth_and_run
    (root / "depth.npy").unlink()
    assert evaluate_run(root, sequence).missing == {"depth": "the run has no depth.npy"}


def test_tracks_of_another_origin_are_not_scored(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, _, root = truth_and_run
    tracks = make_tracks()
    labels = np.zeros(TRACKS, np.int32)
    weight = np.ones((TRACKS, FRAMES), np.float32)
    save_labels(RunFolder(root).labels, LabelledTracks(tracks, labels, labels, weight, weight))
    assert evaluate_run(root, sequence).missing == {}
    other = dataclasses.replace(tracks, query_frame=tracks.query_frame + 1)
    save_labels(RunFolder(root).labels, LabelledTracks(other, labels, labels, weight, weight))
    report = evaluate_run(root, sequence)
    assert "not the sequence's own" in report.missing["landmarks"]
    assert "not the sequence's own" in report.missing["dynamic_points"]


def test_another_sequence_is_refused(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, _, root = truth_and_run
    shorter = dataclasses.replace(sequence, images=ArrayFrames(np.zeros((3, *SIZE, 3), np.uint8)))
    with pytest.raises(InputError, match="6 frames but sequence 'made up' has 3"):
        evaluate_run(root, shorter)


def test_rigid_objects_are_scored_in_the_frames_that_see_them(
    truth_and_run: tuple[Sequence, Reconstruction, Path],
) -> None:
    sequence, reconstruction, root = truth_and_run
    assert "Rigid objects" not in format_report(evaluate_run(root, sequence))  # the run did not search for any
    cameras = sequence.ground_truth.world_T_cam
    assert cameras is not None
    rng = np.random.default_rng(3)
    true = se3.se3_exp(0.3 * rng.normal(size=(2, FRAMES, 6)))
    true[:, :, :3, 3] += 5.0
    # The same motion in another world and with another object frame, turned by 1 degree in frame 4.
    world, own = se3.se3_exp(rng.normal(size=6)), se3.se3_exp(rng.normal(size=6))
    found = world @ true[:1] @ own
    # About the true origin: nothing is displaced.
    turn = se3.se3_exp(np.array([np.radians(1.0), 0.0, 0.0, 0.0, 0.0, 0.0]))
    found[0, 4] = world @ true[0, 4] @ turn @ own
    observed = np.ones((2, FRAMES), bool)
    observed[:, 3] = False
    found[0, 0], observed[0, 0] = np.nan, False
    poses = np.concatenate([found, np.broadcast_to(np.eye(4), found.shape)])
    changed = dataclasses.replace(
        reconstruction,
        world_T_cam=world @ cameras,
        object_instance=np.array([7, 9], np.int32),
        object_reference=np.array([1, 1], np.int32),
        object_observed=observed,
        object_world_T_object=poses,
        object_covariance=np.zeros((2, FRAMES, 6, 6)),
        object_velocity=np.zeros((2, FRAMES, 6)),
    )
    save_reconstruction(RunFolder(root).reconstruction, changed)
    assert evaluate_run(root, sequence).missing["rigid_objects"] == "no ground truth"
    truth = dataclasses.replace(sequence.ground_truth, rigid_instance=np.array([7, 8], np.int32), world_T_object=true)
    report = evaluate_run(root, dataclasses.replace(sequence, ground_truth=truth))
    objects = report.rigid_objects
    assert objects is not None
    assert (objects.without_truth, objects.not_found) == ((9,), (8,))
    (one,) = objects.objects
    assert (one.instance, one.frames) == (7, FRAMES - 2)
    assert one.rotation_max_deg == pytest.approx(1.0, rel=1e-6)
    assert one.rotation_rms_deg == pytest.approx(1.0 / np.sqrt(FRAMES - 2), rel=1e-6)
    assert one.distance_max == pytest.approx(0.0, abs=1e-9)
    assert report.to_dict()["rigid_objects"]["not_found"] == [8]
    text = format_report(report)
    assert "instance 7, rotation RMS / max" in text
    assert "instance 8" in text


def test_depth_is_compared_with_itself_without_any_truth(
    truth_and_run: tuple[Sequence, Reconstruction, Path],
) -> None:
    sequence, reconstruction, root = truth_and_run
    flicker = np.array([0.0, 0.2, -0.1, 0.3, 0.0, 0.1])
    wall = np.full((FRAMES, *SIZE), 2.0, np.float32)
    sequence = dataclasses.replace(
        sequence,
        depths=ArrayFrames(wall * np.exp(-flicker)[:, None, None].astype(np.float32)),
        ground_truth=GroundTruth(),
    )
    at_rest = dataclasses.replace(
        reconstruction, world_T_cam=np.tile(np.eye(4), (FRAMES, 1, 1)), depth_log_scale=flicker
    )
    folder = RunFolder(root)
    save_reconstruction(folder.reconstruction, at_rest)
    with write_depth(folder.depth, FRAMES, SIZE) as writer:
        for frame in range(FRAMES):
            writer.write(frame, wall[frame] * (1.02 if frame == FRAMES - 1 else 1.0))
    report = evaluate_run(root, sequence)
    assert report.self_consistency is not None
    fused, cue = report.self_consistency["fused"], report.self_consistency["cue"]
    # Half of each frame is static; of the five pairs, the last differs by 2 %.
    assert fused.pixels == cue.pixels == (FRAMES - 1) * SIZE[0] * SIZE[1] // 2
    assert fused.mean == pytest.approx((1.0 - 1.0 / 1.02) / (FRAMES - 1), rel=1e-4)
    assert (fused.below_1, fused.below_5) == (0.8, 1.0)
    assert cue.mean == pytest.approx(0.0, abs=1e-6)
    lines = format_report(report).split("Depth against itself\n")[1].splitlines()
    assert lines[2].split() == ["fused", "0.0039", "80.00", "%", "100.00", "%"]


def test_a_folder_may_be_a_text(truth_and_run: tuple[Sequence, Reconstruction, Path]) -> None:
    sequence, _, run = truth_and_run
    assert evaluate_run(str(run), sequence).to_dict() == evaluate_run(run, sequence).to_dict()
