"""Experiments over datasets: damaged videos, outputs of other programs, grids, printed tables, stored results."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import miniatures
import numpy as np
import pytest
import test_benchmark_methods as methods
import yaml
from hostile import changed_array, changed_json, damaged, judged, judged_verb, state_of
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.frontend.datasets.base import PngDepth, make_video
from uni4d_fg.frontend.datasets.registry import find_dataset
from uni4d_fg.frontend.datasets.tum_files import read_file_list, read_pose_list
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Video
from uni4d_fg.pipeline.benchmark.grid import read_grid
from uni4d_fg.pipeline.benchmark.methods import read_method
from uni4d_fg.pipeline.benchmark.methods.exr import read_exr
from uni4d_fg.pipeline.benchmark.published import FILE, read_published
from uni4d_fg.pipeline.benchmark.score import NO_MASKS
from uni4d_fg.pipeline.benchmark.tables import Method
from uni4d_fg.pipeline.benchmark.task import Configuration, Task

hostile = settings(settings.get_profile("hostile"))
slower = settings(hostile, max_examples=max(1, hostile.max_examples // 4))

DATASETS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "sintel": (miniatures.sintel, "alley_2"),
    "tum-dynamics": (miniatures.tum, "walking_xyz"),
    "bonn": (miniatures.bonn, "balloon2"),
    "kitti": (miniatures.kitti, "2011_09_26_drive_0002_sync"),
    "davis": (miniatures.davis, "bear"),
}


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One small video of every dataset, not to be changed."""
    folder = tmp_path_factory.mktemp("datasets")
    for name, (make, _) in DATASETS.items():
        make(folder / name)
    return folder


def read_all(name: str, root: Path, video: str) -> None:
    dataset = find_dataset(name)
    dataset.videos(root)
    dataset.notes(root, video)
    opened = dataset.open(root, video)
    assert np.isfinite(opened.timestamps).all()
    truth = opened.ground_truth
    for frames in (opened.images, truth.depths, truth.masks):
        for number in range(0 if frames is None else len(frames)):
            frames[number]
    if truth.intrinsics is not None:
        assert np.isfinite(truth.intrinsics).all()


@hostile
@given(data=st.data())
def test_datasets_with_damaged_files(
    datasets: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    name = data.draw(st.sampled_from(sorted(DATASETS)))
    root = tmp_path_factory.getbasetemp() / "damaged-dataset"
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(datasets / name, root)
    paths = sorted(path for path in root.rglob("*") if path.is_file())
    lists = [path for path in paths if path.suffix == ".txt"]
    choice = st.sampled_from(paths) | st.sampled_from(lists) if lists else st.sampled_from(paths)
    for path in data.draw(st.lists(choice, min_size=1, max_size=3, unique=True)):
        kind = data.draw(st.sampled_from(["damage", "damage", "remove", "rename", "words"]))
        if kind == "remove":
            path.unlink()
        elif kind == "rename":
            number = data.draw(st.sampled_from(["", "x", "9" * 12, "9" * 200, "\u00b2", "-1"]))
            path.rename(path.with_name(f"frame_{number}{path.suffix}"))
        elif kind == "words" and path.suffix == ".txt":
            words = path.read_text().split(" ")
            words[data.draw(st.integers(0, len(words) - 1))] = data.draw(
                st.sampled_from(["nan", "inf", "1e400", "-1", "0", "1e300", "x", "../../x.png", "9" * 5000, "\n"])
            )
            path.write_text(" ".join(words))
        else:
            path.write_bytes(data.draw(damaged(path.read_bytes())))
    judged(read_all, name, root, DATASETS[name][1])


LAYOUTS = sorted(methods.WRITERS)


def sample_video() -> Video:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (methods.FRAMES, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(methods.FRAMES, 3))
    depth = rng.uniform(1.0, 5.0, (methods.FRAMES, *methods.SIZE)).astype(np.float32)
    truth = GroundTruth(world_T_cam=poses, depths=ArrayFrames(depth), intrinsics=np.array([20.0, 21.0, 7.5, 5.5]))
    return Video(
        "v", ArrayFrames(np.zeros((methods.FRAMES, *methods.SIZE, 3), np.uint8)), methods.SIZE,
        10.0 + np.arange(methods.FRAMES) / 30.0, frame_names=tuple(f"im{i}" for i in range(methods.FRAMES)),
        ground_truth=truth,
    )  # fmt: skip


def read(text: str, folder: Path, depth_protocols: tuple[str, ...]) -> Method:
    """Read what another program wrote about a dataset of one video in memory."""
    task = Task("sintel", str(folder), "v", Configuration("x"), str(folder), None, None, ("sim3",), depth_protocols)
    with patch("uni4d_fg.pipeline.benchmark.methods.open_task", lambda task: sample_video()):
        return read_method(text, [task], lambda task: (None, NO_MASKS))


@hostile
@given(data=st.data())
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers that are read from the files
def test_outputs_of_other_programs(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    layout = data.draw(st.sampled_from(LAYOUTS))
    folder = tmp_path_factory.getbasetemp() / "output"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    methods.WRITERS[layout](folder, sample_video())
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    for path in data.draw(st.lists(st.sampled_from(paths), min_size=1, max_size=3, unique=True)):
        if path.suffix == ".npz" and data.draw(st.booleans()):
            with np.load(path) as stored:
                arrays = dict(stored)
            name = data.draw(st.sampled_from(sorted(arrays)))
            arrays[name] = data.draw(changed_array(arrays[name]))
            np.savez(path, **arrays)
        else:
            path.write_bytes(data.draw(damaged(path.read_bytes())))
    judged(read, f"{layout}:theirs={folder}", folder, ("metric", "uni4d-scale"))


def test_depth_of_another_size_in_one_frame_costs_that_video_only(tmp_path: Path) -> None:
    methods.WRITERS["uni4d"](tmp_path, sample_video())
    path = sorted(tmp_path.rglob("*.npz"))[1]
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **{**arrays, "disp": arrays["disp"][:-1]})
    found = judged(read, f"uni4d={tmp_path}", tmp_path, ())
    assert "maps of one size" in str(found.results["v"].failed)


@hostile
@given(data=st.data())
def test_exr_files(data: st.DataObject) -> None:
    depth = np.add.outer(np.arange(20.0), np.arange(9.0)).astype(np.float32)
    whole = methods.exr(depth, data.draw(st.sampled_from(["none", "zip"])), data.draw(st.sampled_from(["f2", "f4"])))
    judged(read_exr, data.draw(damaged(whole)), "x.exr")


GRID = {
    "base": {"preset": "default", "set": ["output.pictures=false"]},
    "rows": {
        "default": {},
        "without ARAP": {"set": ["nonrigid.arap_weight=0"]},
        "known": {"intrinsics": "known", "depth": "cue", "masks": "cue"},
    },
    "grid": {"solver": ["lm", "adam"], "preset": ["default", "paper"]},
}


@hostile
@given(data=st.data())
def test_grids(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / "grid.yaml"
    path.write_text(yaml.safe_dump(data.draw(changed_json(GRID))), "utf-8", "surrogatepass")
    judged(read_grid, path)


@pytest.mark.parametrize(
    "grid",
    [
        {"base": {"set": 5}, "rows": {"a": {}}},
        {"base": {"set": None}, "rows": {"a": {}}},
        {"rows": {"a": {"set": "backend=cpp"}}},
        {"rows": {"a": {"set": 5}}},
        {"rows": {"x" * 300: {}}},
        {"rows": {"a\x00b": {}}},
        {"rows": {"..": {}}},
        {"grid": {f"x{i}": list(range(100)) for i in range(12)}},
        {"grid": {"solver": []}},
        {"rows": {str(i): {} for i in range(10_000)}},
    ],
)
def test_a_grid_that_is_wrong_is_one_clear_error(tmp_path: Path, grid: dict[str, Any]) -> None:
    path = tmp_path / "grid.yaml"
    path.write_text(json.dumps(grid))
    assert isinstance(judged(read_grid, path), ConfigError)
    code, _, err = judged_verb("ablate", "sintel", path, "--root", tmp_path, "--out", tmp_path / "out")
    assert code == 2
    assert "grid.yaml" in err
    assert not (tmp_path / "out").exists()


@slower
@given(data=st.data())
def test_printed_tables(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / "published.yaml"
    path.write_text(yaml.safe_dump(data.draw(changed_json(yaml.safe_load(FILE.read_text())[:2]))), "utf-8")
    judged(read_published, path)


@pytest.fixture(scope="module")
def experiment(sequence_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished benchmark of one sequence, and its dataset; not to be changed."""
    base = tmp_path_factory.mktemp("experiment")
    (base / "root").mkdir()
    shutil.copytree(sequence_folder, base / "root" / "room")
    assert judged_verb(*benchmark(base))[0] == 0
    return base


def benchmark(base: Path) -> list[Any]:
    return [
        "benchmark", "native", "--root", base / "root", "--out", base / "out", "--config", "fast", "--set",
        "output.clouds=false", "--set", "output.pictures=false", "--workers", "1", "--no-pictures", "--quiet",
    ]  # fmt: skip


@slower
@given(data=st.data())
def test_stored_results(experiment: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    base = tmp_path_factory.getbasetemp() / "changed-experiment"
    if not base.exists():
        shutil.copytree(experiment, base)
    stored = next((experiment / "out" / "results").rglob("*.json"))
    whole = json.loads(stored.read_text())
    # The key holds the paths; the copy has others.
    task = Task("native", str(base / "root"), "room", Configuration("fast"), str(base / "out"))
    path = base / stored.relative_to(experiment)
    text = json.dumps({**data.draw(changed_json(whole)), "key": whole["key"]})
    path.write_text(text)
    before = {name: content for name, content in state_of(base / "root").items()}
    assert task.result_file == path
    judged_verb(*benchmark(base))
    assert state_of(base / "root") == before


WORDS = st.sampled_from(
    [
        "native", "sintel", "nosuch", "--root", "--out", ".", "/dev/null", "/dev/zero", "none", "--grid", "--read",
        "files:a=.", "monst3r=/dev/null", "a=b", "--protocol", "sim3", "--split", "--video", "x" * 300, "~nosuchuser",
        "--check", "--workers", "0", "--threads", "-1", "--time-limit", "nan", "--retries", "--scheduler", "tcp://0:1",
        "--cues", "--config", "fast", "--set", "=", "--max-size", "\udcff", "", "--intrinsics", "both",
    ]
)  # fmt: skip


@hostile
@given(verb=st.sampled_from(["benchmark", "ablate"]), words=st.lists(WORDS, max_size=6))
def test_any_words(tmp_path_factory: pytest.TempPathFactory, verb: str, words: list[str]) -> None:
    folder = tmp_path_factory.getbasetemp() / "experiments"
    folder.mkdir(exist_ok=True)
    here = Path.cwd()
    os.chdir(folder)
    try:
        judged_verb(verb, *words)
    finally:
        os.chdir(here)


def test_a_gap_in_frame_numbers_takes_no_memory(datasets: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(datasets / "sintel", tmp_path / "sintel"))
    last = sorted((root / "training" / "final" / "alley_2").iterdir())[-1]
    last.rename(last.with_name(f"frame_{10**15}.png"))
    assert "between others" in str(judged(find_dataset("sintel").open, root, "alley_2"))


def test_lists_with_times_closer_than_any_camera_take_no_time(tmp_path: Path) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg3_walking_xyz"
    miniatures.tum(tmp_path)
    for name, columns in (("rgb.txt", "a.png"), ("groundtruth.txt", "0 0 0 0 0 0 1")):
        (folder / name).write_text("".join(f"{i * 1e-7:.7f} {columns}\n" for i in range(100_000)))
    assert isinstance(judged(find_dataset("tum-dynamics").open, tmp_path, "walking_xyz"), InputError)
    assert len(read_file_list(folder / "rgb.txt").times) == len(read_pose_list(folder / "groundtruth.txt").times)


def test_fewer_true_poses_than_images(datasets: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(datasets / "bonn", tmp_path / "bonn"))
    path = next(root.rglob("groundtruth.txt"))
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-3]))
    assert isinstance(judged(find_dataset("bonn").notes, root, "balloon2"), tuple)
    assert "groundtruth.txt" in str(judged(find_dataset("bonn").open, root, "balloon2"))


def test_times_that_are_no_numbers_are_refused(datasets: Path) -> None:
    folder = datasets / "sintel" / "training" / "final" / "alley_2"
    paths = tuple(sorted(folder.iterdir()))
    for times in (np.full(len(paths), np.nan), np.arange(len(paths)) + np.array([np.inf] * len(paths))):
        assert "times do not increase" in str(judged(make_video, "x", folder, paths, times, GroundTruth()))


def test_true_depth_of_another_size_is_refused(tmp_path: Path) -> None:
    miniatures.save(tmp_path / "a.png", np.ones((5, 7), np.uint16))
    assert isinstance(judged(PngDepth((tmp_path / "a.png",), (6, 7), 1000.0).__getitem__, 0), InputError)
