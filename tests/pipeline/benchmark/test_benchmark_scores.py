"""Scores of runs and of what others wrote: the same masks and cameras for both, and tracks in 3D against loops."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmark_scenes import CONFIG, sintel_task, synthesize
from scipy.spatial.transform import Rotation

from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence, Video
from uni4d_fg.frontend.sequence.resize import resize_nearest, scale_intrinsics
from uni4d_fg.pipeline.benchmark.methods import read_method
from uni4d_fg.pipeline.benchmark.prepare import prepare
from uni4d_fg.pipeline.benchmark.runner import run_task
from uni4d_fg.pipeline.benchmark.score import estimates_of_run, score_estimate
from uni4d_fg.pipeline.benchmark.tables import Method, consistency_table, tracks_table
from uni4d_fg.pipeline.benchmark.task import Task, TaskResult
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.evaluate.protocols.consistency import score_consistency
from uni4d_fg.results.evaluate.run import evaluate_run
from uni4d_fg.results.io import load_reconstruction, save_reconstruction
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.reconstruction import Reconstruction

pytest.importorskip("open3d")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One video of Sintel with its cues, and the true masks."""
    folder = tmp_path_factory.mktemp("sintel")
    synthesize(folder, "sintel", "alley_2")
    return folder


@pytest.fixture(scope="module")
def done(root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Task, TaskResult]:
    """A run of it."""
    task = sintel_task(root, tmp_path_factory.mktemp("out"))
    return task, run_task(task)


def write_as_files(run: Path, folder: Path, step: int = 1) -> None:
    """Write cameras and depth of a run as another program would, depth of every so many pixels."""
    files = RunFolder(run)
    found, depths = load_reconstruction(files.reconstruction), np.stack(list(read_depth(files.depth)))
    size = depths.shape[1] // step, depths.shape[2] // step
    fx, fy, cx, cy = scale_intrinsics(found.intrinsics, depths.shape[1:], size)
    folder.mkdir(parents=True)
    np.save(folder / "c2w.npy", found.world_T_cam)
    np.save(folder / "depth.npy", np.stack([resize_nearest(depth, size) for depth in depths]))
    np.save(folder / "K.npy", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))


def test_what_is_read_is_scored_with_the_masks_of_the_runs(done: tuple[Task, TaskResult], tmp_path: Path) -> None:
    task, result = done
    write_as_files(task.run_folder, tmp_path / "whole" / "alley_2")
    write_as_files(task.run_folder, tmp_path / "half" / "alley_2", step=2)
    whole = read_method(f"files:again={tmp_path / 'whole'}", [task])
    own, read = (r.scores["consistency"] for r in (result, whole.results["alley_2"]))
    assert own["masks"] == "by masks of the cues"
    assert read == own
    assert whole.results["alley_2"].scores["depth"] == result.scores["depth"]
    # Without the masks there are more pixels, and things that move do not lie where they lay.
    found = load_reconstruction(RunFolder(task.run_folder).reconstruction)
    depths = read_depth(RunFolder(task.run_folder).depth)
    nothing = ArrayFrames(np.zeros((7, 60, 80), np.int32))
    bare = score_consistency(depths, nothing, found.world_T_cam, found.intrinsics)
    assert bare is not None
    assert bare.pixels > own["pixels"] + 200
    assert bare.mean > 1.1 * own["mean"]
    # Masks take the size of the depth that was read.
    half = read_method(f"files:small={tmp_path / 'half'}", [task]).results["alley_2"].scores["consistency"]
    masks = ArrayFrames(np.stack([resize_nearest(mask, (30, 40)) for mask in prepare(task).sequence.masks]))
    small = ArrayFrames(np.load(tmp_path / "half" / "alley_2" / "depth.npy"))
    cameras = scale_intrinsics(found.intrinsics, (60, 80), (30, 40))
    expected = score_consistency(small, masks, found.world_T_cam, cameras)
    assert expected is not None
    assert half == expected.to_dict() | {"masks": "by masks of the cues"}
    note = consistency_table("x", [Method("fast", {"alley_2": result}), whole], []).notes[0]
    assert note.endswith("left out; static pixels: by masks of the cues")


def test_what_others_wrote_stands_in_the_tables_of_a_command(
    done: tuple[Task, TaskResult], cli: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    task, result = done
    write_as_files(task.run_folder, tmp_path / "whole" / "alley_2")
    poses = load_reconstruction(RunFolder(task.run_folder).reconstruction).world_T_cam
    (tmp_path / "part").mkdir()
    rows = [(t, *poses[t, :3, 3], *Rotation.from_matrix(poses[t, :3, :3]).as_quat()) for t in (0, 1, 3, 6)]
    np.savetxt(tmp_path / "part" / "alley_2.txt", rows, fmt="%.12g")
    words = ["benchmark", "sintel", "--root", task.root, "--out", task.out, "--config", "fast", "--video", "alley_2",
             "--protocol", "sim3", "--protocol", "uni4d-scale", "--no-pictures", "--quiet", "--workers", 1,
             *(word for change in CONFIG for word in ("--set", change)),
             "--read", f"files:Again={tmp_path / 'whole'}", "--read", f"dpvo={tmp_path / 'part'}",
             "--read", f"monst3r={tmp_path / 'nothing'}"]  # fmt: skip
    assert cli(*words)[0] == 0
    tables = Path(task.out) / "tables"
    found = {
        name: {row["method"]: row for row in csv.DictReader((tables / f"{name}.csv").open())}
        for name in ("poses-sim3", "depth-uni4d-scale", "consistency", "short")
    }
    own, again, part, none = (found["poses-sim3"][name] for name in ("fast", "Again", "dpvo", "monst3r"))
    assert [row["kind"] for row in (own, again, part, none)] == ["run", "read", "read", "read"]
    assert float(own["ATE"]) == result.scores["poses"]["sim3"]["ate"]
    assert float(again["ATE"]) == pytest.approx(float(own["ATE"]), rel=1e-9)
    assert [row["posed"] for row in (own, again, part, none)] == ["7", "7", "4", ""]
    assert [row["failed"] for row in (own, again, part, none)] == ["0", "0", "0", "1"]
    assert found["depth-uni4d-scale"]["Again"]["AbsRel moving"] == found["depth-uni4d-scale"]["fast"]["AbsRel moving"]
    assert found["consistency"]["Again"]["SC"] == found["consistency"]["fast"]["SC"]
    assert found["consistency"]["dpvo"]["SC"] == ""
    assert (found["short"]["dpvo"]["posed"], found["short"]["dpvo"]["of frames"]) == ("4", "7")
    for text in ((tables / "poses-sim3.md").read_text(), (tables / "poses-sim3.tex").read_text()):
        assert "dpvo (read)" in text
        assert "Again: read from files in the layout of files" in text
    failed = json.loads((Path(task.out) / "benchmark.json").read_text())["failed"]
    assert [list(failed[name]) for name in ("Again", "monst3r")] == [[], ["alley_2"]]


@pytest.mark.parametrize(
    ("masks", "source"),
    [("motion", "by masks from motion"), ("true", "by true masks"), ("none", "all, without masks")],
)
def test_the_masks_that_count_are_those_that_the_run_takes(masks: str, source: str, root: Path, tmp_path: Path) -> None:
    task = sintel_task(root, tmp_path / "out", masks=masks)
    result = run_task(task)
    assert result.failed is None
    write_as_files(task.run_folder, tmp_path / "read" / "alley_2")
    read = read_method(f"files={tmp_path / 'read'}", [task]).results["alley_2"]
    assert read.scores["consistency"] == result.scores["consistency"]
    assert read.scores["consistency"]["masks"] == source


def test_a_zoom_and_scales_of_the_cue_count_in_benchmark_and_evaluate_alike(
    done: tuple[Task, TaskResult], tmp_path: Path
) -> None:
    task, result = done
    sequence, plain, changed = prepare(task).sequence, RunFolder(task.run_folder), RunFolder(tmp_path)
    found = load_reconstruction(plain.reconstruction)
    zoom, log_scale = np.linspace(0.8, 1.2, 7), np.linspace(-0.1, 0.1, 7)
    save_reconstruction(changed.reconstruction, replace(found, zoom=zoom, depth_log_scale=log_scale))
    changed.depth.write_bytes(plain.depth.read_bytes())
    for folder in (plain.root, changed.root):
        report = evaluate_run(folder, sequence).self_consistency
        assert report is not None
        for name, estimate in zip(("fused", "cue"), estimates_of_run(folder, sequence), strict=True):
            score = score_estimate(as_video(sequence), estimate, "sintel", (), (), sequence.masks)["consistency"]
            assert score == report[name].to_dict() | {"masks": score["masks"]}
            if folder == plain.root:
                told = result.scores if name == "fused" else result.scores["depth_cue"]
                assert told["consistency"]["mean"] == score["mean"]
            else:  # of cameras that the run does not have
                assert score["mean"] > 2.0 * result.scores["consistency"]["mean"]
    own, cue = estimates_of_run(changed.root, sequence)
    np.testing.assert_array_equal(own.intrinsics, found.intrinsics * np.stack((zoom, zoom, zoom**0, zoom**0), axis=1))
    np.testing.assert_array_equal(cue.log_scale, log_scale)


def as_video(sequence: Sequence) -> Video:
    return Video(
        sequence.name, sequence.images, sequence.image_size, sequence.timestamps, tracks=sequence.tracks,
        ground_truth=sequence.ground_truth,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Sequence:
    """Five frames with things that move, all tracks with truth."""
    from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence

    return make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=5, width=80, height=60, focal=75.0, grid_columns=10, grid_rows=8, query_interval=2,
            margin_px=3.0, frame_rate=5.0,
        )
    )  # fmt: skip


def run_of(
    sequence: Sequence, points: np.ndarray, seen: np.ndarray, folder: Path, scale: float = 1.0
) -> Reconstruction:
    """Write a run that has the true cameras, and a point (T, 3) of the world for every track that moves."""
    truth, tracks = sequence.ground_truth, sequence.tracks
    assert truth.world_T_cam is not None
    assert truth.intrinsics is not None
    assert tracks is not None
    with np.errstate(invalid="ignore"):
        moving = np.nanmax(np.ptp(points, axis=1), axis=1) > 1e-9
    static_track, moving_track = (np.flatnonzero(rows).astype(np.int32) for rows in (~moving, moving))
    cameras = truth.world_T_cam.copy()
    cameras[:, :3, 3] *= scale
    run = Reconstruction(
        cameras, truth.intrinsics, sequence.timestamps, sequence.image_size, np.zeros(len(cameras)),
        scale * points[static_track, 0], static_track, np.zeros((len(static_track), 3), np.uint8),
        np.zeros(len(static_track), np.float32), scale * points[moving_track], seen[moving_track], moving_track,
        np.ones(len(moving_track), np.int32), np.zeros((len(moving_track), 3), np.uint8),
    )  # fmt: skip
    save_reconstruction(RunFolder(folder).reconstruction, run)
    return run


def test_a_perfect_run_tracks_perfectly(scene: Sequence, tmp_path: Path) -> None:
    truth, tracks = scene.ground_truth.track_points, scene.tracks
    assert truth is not None
    assert tracks is not None
    run = run_of(scene, truth, tracks.visible, tmp_path)
    assert min(len(run.landmark_track), len(run.dynamic_track)) > 20
    scores = score_estimate(as_video(scene), estimates_of_run(tmp_path, scene)[0], "synthetic", (), ())["tracks"]
    assert (scores["average_jaccard"], scores["points_within"], scores["occlusion_accuracy"]) == (1.0, 1.0, 1.0)
    assert scores["tracks"] == tracks.num_tracks
    # Lengths of another unit are not an error.
    run_of(scene, truth, tracks.visible, tmp_path / "half", scale=0.5)
    half = score_estimate(as_video(scene), estimates_of_run(tmp_path / "half", scene)[0], "synthetic", (), ())["tracks"]
    assert (half["average_jaccard"], half["occlusion_accuracy"]) == (1.0, 1.0)


def test_a_run_with_known_errors_has_the_track_scores_of_plain_loops(
    scene: Sequence, tmp_path: Path, rng: np.random.Generator
) -> None:
    truth, tracks, cameras = scene.ground_truth.track_points, scene.tracks, scene.ground_truth.world_T_cam
    assert truth is not None
    assert tracks is not None
    assert cameras is not None
    moved = truth + rng.normal(scale=0.15, size=truth.shape)
    seen = tracks.visible & (rng.random(tracks.visible.shape) < 0.8)
    run_of(scene, moved, seen, tmp_path, scale=0.25)
    scores = score_estimate(as_video(scene), estimates_of_run(tmp_path, scene)[0], "synthetic", (), ())["tracks"]
    lengths: list[list[float]] = [[], []]
    cases = []
    for k in range(tracks.num_tracks):
        for t in range(len(cameras)):
            inverse = np.linalg.inv(cameras[t])
            there, here = (inverse[:3, :3] @ p[k, t] + inverse[:3, 3] for p in (truth, moved))
            cases.append((there, here, bool(tracks.visible[k, t]), bool(seen[k, t])))
            if tracks.visible[k, t] and seen[k, t]:
                lengths[0].append(float(np.linalg.norm(there)))
                lengths[1].append(float(np.linalg.norm(here)))
    scale = np.median(lengths[0]) / np.median(lengths[1])
    jaccard, within = [], []
    visible = sum(case[2] for case in cases)
    for threshold in (1, 2, 4, 8, 16):
        hit = true_positives = false_positives = 0
        for there, here, is_seen, is_told in cases:
            near = np.linalg.norm(scale * here - there) < threshold * there[2] / 75.0
            hit += near and is_seen
            true_positives += near and is_seen and is_told
            false_positives += is_told and not (near and is_seen)
        jaccard.append(true_positives / (visible + false_positives))
        within.append(hit / visible)
    accuracy = np.mean([case[2] == case[3] for case in cases])
    found = scores["average_jaccard"], scores["points_within"], scores["occlusion_accuracy"]
    assert found == pytest.approx((np.mean(jaccard), np.mean(within), accuracy), abs=1e-9)
    assert 0.1 < found[0] < found[1] < 0.9
    # The table averages over videos that have a score.
    results = {
        name: TaskResult("", name, "x", None, 5, {} if score is None else {"tracks": score})
        for name, score in (("a", scores), ("b", scores | {"average_jaccard": 1.0}), ("c", None))
    }
    (row,) = tracks_table("x", [Method("x", results)]).rows
    assert row.values["3D-AJ"] == pytest.approx((found[0] + 1.0) / 2)
    assert (row.values["APD"], row.values["OA"]) == pytest.approx(found[1:])
    assert (row.values["videos"], row.values["failed"]) == (2, 0)
