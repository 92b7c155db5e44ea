"""A dataset from its folder to its tables by one command; failures counted, restarts doing only what is missing."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmark_scenes import CONFIG, sintel_task, synthesize

from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.datasets import synthetic
from uni4d_fg.frontend.datasets.registry import find_dataset
from uni4d_fg.frontend.sequence.assemble import as_sequence
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.pipeline.benchmark import runner
from uni4d_fg.pipeline.benchmark.prepare import open_task, prepare, with_cues
from uni4d_fg.pipeline.benchmark.runner import one_after_the_other, run_task, run_tasks
from uni4d_fg.pipeline.benchmark.score import Estimate, score_estimate
from uni4d_fg.pipeline.benchmark.task import Task, TaskResult
from uni4d_fg.results.evaluate.run import evaluate_run

pytest.importorskip("open3d")

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two videos of Sintel, and one without its depth."""
    folder = tmp_path_factory.mktemp("sintel")
    synthesize(folder, "sintel", "alley_2", "ambush_4", "cave_2")
    shutil.rmtree(folder / "training" / "depth" / "cave_2")
    return folder


def test_one_command_runs_and_scores_a_dataset(root: Path, cli: Run, tmp_path: Path) -> None:
    videos = [word for video in ("alley_2", "ambush_4", "cave_2") for word in ("--video", video)]
    words = [
        "benchmark", "sintel", "--root", root, "--out", tmp_path, "--config", "fast", "--intrinsics", "both", "--quiet",
        "--workers", 1, *videos, "--protocol", "sim3", "--protocol", "uni4d-scale", "--protocol", "uni4d-scale-shift",
        *(word for change in CONFIG for word in ("--set", change)),
    ]  # fmt: skip
    code, out, _ = cli(*words)
    assert code == 0
    assert "| Uni4D (published) | 0.110 |" in out
    assert "cave_2" in out
    assert "MPI-Sintel-depth-training" in out  # where to get what cave_2 lacks
    rows = {row["method"]: row for row in csv.DictReader((tmp_path / "tables" / "poses-sim3.csv").open())}
    for name in ("fast", "fast*"):
        assert float(rows[name]["ATE"]) < 0.02
        assert (rows[name]["videos"], rows[name]["failed"]) == ("2", "1")
    depth = {row["method"]: row for row in csv.DictReader((tmp_path / "tables" / "depth-uni4d-scale.csv").open())}
    assert float(depth["fast"]["AbsRel"]) < float(depth["depth cue"]["AbsRel"])
    assert float(depth["fast"]["AbsRel moving"]) < 0.1
    told = json.loads((tmp_path / "benchmark.json").read_text())
    assert list(told["failed"]["fast"]) == ["cave_2"]
    assert {t["name"] for t in told["tables"]} >= {"poses-sim3", "poses-sim3-videos", "stages-sim3", "runtime"}
    pictures = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert pictures == {
        "alley_2-path.png", "alley_2-depth.png", "ambush_4-path.png", "ambush_4-depth.png", "runtime.png"
    }  # fmt: skip
    page = (tmp_path / "benchmark.md").read_text()
    assert page.index("Sintel (final): in short") < page.index("camera poses, `sim3`")
    assert {name.split(")")[0].removeprefix("pictures/") for name in page.split("](")[1:]} == pictures
    assert "AbsRel of every video, `uni4d-scale`" in page
    assert "AbsRel of every video, `uni4d-scale-shift`" not in page  # in its own file
    assert "tables/depth-uni4d-scale-shift-videos.md" in page
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "results").rglob("*.json")}
    assert cli(*words, "--no-pictures")[0] == 0
    changed = {path.stem for path, time in before.items() if path.stat().st_mtime_ns != time}
    assert changed == {"cave_2"}  # what failed is tried again, and nothing else


def test_what_is_there_can_be_looked_at_before_anything_is_run(root: Path, cli: Run, tmp_path: Path) -> None:
    words = ["benchmark", "sintel", "--root", root, "--out", tmp_path / "out", "--check"]
    code, out, err = cli(*words, "--video", "alley_2", "--video", "cave_2")
    assert code == 3
    assert "alley_2: 7 frames of 80 x 60 px; truth: poses, depth, masks; cues: depth, masks, tracks" in out
    assert "MPI-Sintel-depth-training" in out
    assert "1 of 2 videos cannot be used" in err
    assert not (tmp_path / "out").exists()
    assert cli(*words, "--video", "alley_2")[0] == 0


def test_a_video_that_fails_does_not_stop_the_others(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("no such thing")

    monkeypatch.setattr(runner, "reconstruct", broken)
    tasks = [sintel_task(root, tmp_path), replace(sintel_task(root, tmp_path), video="nosuch")]
    found = [result for result, _ in run_tasks(tasks, one_after_the_other())]
    assert found[0].failed == "unexpected ZeroDivisionError: no such thing"
    assert found[1].failed is not None
    assert "no such folder; download" in found[1].failed
    assert all(t.result_file.is_file() for t in tasks)


def test_any_executor_can_do_the_tasks_and_gets_only_what_is_missing(root: Path, tmp_path: Path) -> None:
    tasks = [replace(sintel_task(root, tmp_path), video=video) for video in ("a", "b", "c")]
    TaskResult(tasks[1].key, "b", "fast").save(tasks[1].result_file)
    asked: list[str] = []

    def execute(left: list[Task]) -> list[TaskResult]:
        asked.extend(t.video for t in left)
        return [TaskResult(t.key, t.video, "fast") for t in reversed(left)]

    found = [(result.video, there) for result, there in run_tasks(tasks, execute)]
    assert asked == ["a", "c"]
    assert found == [("b", True), ("c", False), ("a", False)]
    assert len(list(run_tasks(tasks, execute, fresh=True))) == 3


def test_a_cancelled_task_leaves_no_result(root: Path, tmp_path: Path) -> None:
    one = sintel_task(root, tmp_path)
    with pytest.raises(Cancelled):
        run_task(one, should_stop=lambda: True)
    assert not one.result_file.exists()


def test_what_a_configuration_says_is_what_is_solved(root: Path, tmp_path: Path) -> None:
    plain = prepare(sintel_task(root, tmp_path))
    truth = plain.video.ground_truth
    assert truth.masks is not None
    assert plain.config.input.intrinsics == "free"
    known = prepare(sintel_task(root, tmp_path, intrinsics="known", masks="true", poses="identity"))
    assert known.config.input.intrinsics == "fixed"
    assert known.config.input.poses == "initial"
    np.testing.assert_array_equal(known.sequence.intrinsics, truth.intrinsics)
    np.testing.assert_array_equal(known.sequence.masks[3], truth.masks[3])
    np.testing.assert_array_equal(known.sequence.initial_world_T_cam, np.tile(np.eye(4), (7, 1, 1)))
    assert prepare(sintel_task(root, tmp_path, tracks="built_in")).sequence.tracks is None
    static = prepare(sintel_task(root, tmp_path, masks="none"))
    assert not any(mask.any() for mask in static.sequence.masks)
    small = prepare(replace(sintel_task(root, tmp_path), max_size=40))
    assert small.sequence.image_size == (30, 40)
    assert small.video.image_size == (60, 80)
    kitti = replace(sintel_task(root, tmp_path), dataset="sintel-clean")
    assert open_task(kitti).depths is not None


def test_cues_that_do_not_fit_are_named(root: Path, tmp_path: Path) -> None:
    video = find_dataset("sintel").open(root, "alley_2")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="holds no cue"):
        with_cues(video, empty)
    few = tmp_path / "few"
    shutil.copytree(root / "cues" / "alley_2", few)
    next((few / "depth_cue").iterdir()).unlink()
    with pytest.raises(InputError, match="has 6 frames, but there are 7 images"):
        with_cues(video, few)


def test_the_truth_as_an_estimate_has_no_error(root: Path) -> None:
    video = find_dataset("sintel").open(root, "alley_2")
    truth = video.ground_truth
    exact = Estimate(truth.world_T_cam, truth.depths, truth.intrinsics)
    scores = score_estimate(video, exact, "sintel", ("sim3",), ("metric", "uni4d-scale-shift"), truth.masks)
    assert scores["poses"]["sim3"]["ate"] < 1e-9
    for name in ("metric", "uni4d-scale-shift"):
        regions = scores["depth"][name]["regions"]
        assert all(regions[r]["abs_rel"] < 1e-5 and regions[r]["delta_125"] == 1.0 for r in ("all", "static", "moving"))
    assert scores["consistency"]["mean"] < 0.05  # edges of objects, and slanted walls between pixels
    assert scores["regions"] == "true masks"


def test_ablations_of_a_grid_score_the_cameras_after_every_stage(root: Path, cli: Run, tmp_path: Path) -> None:
    grid = tmp_path / "grid.yaml"
    grid.write_text(
        "base: {preset: fast, set: [output.clouds=false, output.pictures=false]}\n"
        "rows: {whole: {}, without ARAP: {set: [nonrigid.arap_weight=0]}}\n"
    )
    code, out, _ = cli(
        "ablate", "sintel", grid, "--root", root, "--out", tmp_path / "out", "--video", "alley_2", "--protocol", "sim3",
        "--quiet", "--workers", 1,
    )  # fmt: skip
    assert code == 0
    rows = {row["method"]: row for row in csv.DictReader((tmp_path / "out" / "tables" / "stages-sim3.csv").open())}
    assert float(rows["whole, after bundle adjustment"]["ATE"]) < float(rows["whole, after camera init"]["ATE"])
    assert "without ARAP" in out


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["nosuch"], 2, "choose one of sintel"),
        (["sintel", "--video", "nosuch"], 3, "holds no video 'nosuch'"),
        (["sintel", "--protocol", "nosuch"], 2, "choose from sim3"),
        (["sintel", "--split", "nosuch"], 3, "choose one of pose, depth, all"),
        (["sintel", "--intrinsics", "maybe"], 2, "unknown, known or both"),
        (["sintel", "--set", "nosuch=1"], 2, "nosuch"),
        (["sintel", "--cues", "/nowhere"], 3, "no such folder"),
        (["kitti"], 3, "avg-kitti"),
        (["sintel", "--workers", "0"], 2, "--workers 0"),
        (["sintel", "--workers", "2", "--scheduler", "tcp://x:1"], 2, "give one of them"),
        (["sintel", "--video", "alley_2", "--scheduler", "nosuch://x:1"], 3, "no Dask scheduler answers"),
    ],
)
def test_a_wrong_command_is_explained(
    words: list[str], code: int, message: str, root: Path, cli: Run, tmp_path: Path
) -> None:
    found, _, err = cli("benchmark", *words, "--root", root, "--out", tmp_path)
    assert (found, message in err) == (code, True), err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["sintel", "--rows", "most"], "choose one of paper, standard, full"),
        (["sintel", "grid.yaml", "--rows", "full"], "--set and --rows are for rows without a file"),
        (["sintel", "grid.yaml", "--set", "output.clouds=false"], "--set and --rows are for rows without a file"),
    ],
)
def test_rows_of_ablations_are_ready_made_or_from_a_file(
    words: list[str], message: str, root: Path, cli: Run, tmp_path: Path
) -> None:
    code, _, err = cli("ablate", *words, "--root", root, "--out", tmp_path)
    assert (code, message in err) == (2, True), err


def test_synthetic_scenes_need_no_folder_and_other_datasets_say_that_they_do(
    cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = {
        "num_frames": 7, "height": 60, "width": 80, "focal": 75.0, "grid_columns": 14, "grid_rows": 10,
        "query_interval": 4, "margin_px": 3.0, "frame_rate": 4.0,
    }  # fmt: skip
    made = [synthetic.scene_of(step, **small) for step in range(synthetic.COUNT)]
    monkeypatch.setattr(synthetic, "scene_of", lambda step: made[step])
    folder = tmp_path / "scenes"
    assert find_dataset("synthetic").size(folder, "scene_0") == (7, (60, 80))
    assert not folder.exists()  # how large they are is known before they are made
    words = ["--out", tmp_path, "--config", "fast", "--quiet", "--workers", 1, "--no-pictures", "--video", "scene_0"]
    code, _, _ = cli("benchmark", "synthetic", *words, *(word for change in CONFIG for word in ("--set", change)))
    assert code == 0
    assert (folder / "scene_0").is_dir()
    (row,) = csv.DictReader((tmp_path / "tables" / "points.csv").open())
    score = json.loads((tmp_path / "results" / "fast" / "scene_0.json").read_text())["scores"]["points"]
    assert float(row["moving median"]) == pytest.approx(1000.0 * score["moving"]["median_m"])
    report = evaluate_run(tmp_path / "runs" / "fast" / "scene_0", as_sequence(open_video(folder / "scene_0")))
    assert report.dynamic_points is not None
    assert score["moving"]["points"] > 20
    assert score["moving"]["median_m"] == pytest.approx(report.dynamic_points[0].median_m)
    assert score["static"]["points"] > 200
    code, _, err = cli("benchmark", "bonn", "--out", tmp_path)
    assert code == 2
    assert "--root is missing: give the folder of Bonn" in err
