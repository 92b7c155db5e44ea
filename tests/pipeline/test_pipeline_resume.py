"""A run that was cancelled, killed or damaged goes on where it was, and ends like an undisturbed one."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import (
    TINY,
    assert_same_result,
    check_run,
    depth_of,
    make_config,
    make_scene,
    resumed_stages,
    run_sound,
    stop_at,
    temporary_files,
    with_depth,
)

from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.run_folder import RunFolder

pytest.importorskip("open3d")

# Accuracy is not at stake here: few iterations, one solve of the static scene.
QUICK = (
    "camera_init.window=3", "camera_init.solver.max_iterations=4", "nonrigid.solver.max_iterations=4",
    "bundle_adjustment.solver.max_iterations=4", "bundle_adjustment.measure_noise=false",
    "bundle_adjustment.structure=keep", "camera.model=pinhole",
)  # fmt: skip
STAGES = ("tracks", "rolling_shutter", "camera_init", "bundle_adjustment", "nonrigid", "fusion")


def all_stages(resumed: bool) -> dict[str, bool]:
    return dict.fromkeys(STAGES, resumed)


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return make_scene(TINY)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, sequence: Sequence) -> Path:
    """A finished run that nothing disturbed; tests only read it."""
    run_dir = tmp_path_factory.mktemp("undisturbed")
    run_sound(sequence, run_dir, quick())
    return run_dir


@pytest.fixture
def finished(tmp_path: Path, sequence: Sequence) -> Path:
    """A finished run of one test's own."""
    summary, _ = run_sound(sequence, tmp_path / "run", quick())
    assert resumed_stages(summary) == all_stages(False)
    return tmp_path / "run"


def quick(*overrides: str) -> Config:
    return make_config(*QUICK, *overrides)


def count_polls(sequence: Sequence, run_dir: Path) -> int:
    polls = 0

    def should_stop() -> bool:
        nonlocal polls
        polls += 1
        return False

    reconstruct(sequence, run_dir, quick(), should_stop=should_stop)
    return polls


def test_resuming_a_finished_run_takes_everything_over(finished: Path, sequence: Sequence, undisturbed: Path) -> None:
    summary, _ = run_sound(sequence, finished, quick(), resume=True)
    assert resumed_stages(summary) == all_stages(True)
    assert_same_result(finished, undisturbed)


def test_without_resume_everything_is_computed_again(finished: Path, sequence: Sequence, undisturbed: Path) -> None:
    summary, _ = run_sound(sequence, finished, quick())
    assert resumed_stages(summary) == all_stages(False)
    assert_same_result(finished, undisturbed)


@pytest.mark.parametrize(
    ("override", "first"),
    [
        ("labels.band_static_px=4", "tracks"),
        ("camera_init.window=4", "rolling_shutter"),
        ("camera_init.kernel.kind=cauchy", "rolling_shutter"),
        ("bundle_adjustment.depth_sigma=0.031", "rolling_shutter"),
        ("nonrigid.arap_sigma_m=0.011", "nonrigid"),
        ("fusion.smoothing=5", "fusion"),
        ("tracking.window_px=15", None),
        ("output.clouds=true", None),
    ],
)
def test_a_changed_field_recomputes_its_stage_and_all_after_it(
    finished: Path, sequence: Sequence, tmp_path: Path, override: str, first: str | None
) -> None:
    config = quick(override)
    summary, _ = run_sound(sequence, finished, config, resume=True)
    position = len(STAGES) if first is None else STAGES.index(first)
    assert resumed_stages(summary) == {name: index < position for index, name in enumerate(STAGES)}
    run_sound(sequence, tmp_path / "fresh", config)
    assert_same_result(finished, tmp_path / "fresh")


def test_a_changed_depth_pixel_recomputes_everything(finished: Path, sequence: Sequence) -> None:
    depth = depth_of(sequence).copy()
    depth[3, 10, 10] *= np.float32(1.001)
    summary, _ = run_sound(with_depth(sequence, depth), finished, quick(), resume=True)
    assert resumed_stages(summary) == all_stages(False)


def damage(path: Path, how: str) -> None:
    content = path.read_bytes()
    middle = len(content) // 2
    damaged = {
        "empty": b"",
        "cut in half": content[:middle],
        "last byte missing": content[:-1],
        "flipped byte": content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :],
        "something else": b"no array at all\n" * 20,
    }
    path.write_bytes(damaged[how])


def test_a_damaged_stage_file_is_computed_again(finished: Path, sequence: Sequence, undisturbed: Path) -> None:
    ways = ("empty", "empty", "cut in half", "last byte missing", "flipped byte", "something else")
    for stage, how in zip(STAGES, ways, strict=True):
        damage(finished / "stages" / f"{stage}.npz", how)
        summary, _ = run_sound(sequence, finished, quick(), resume=True)
        assert resumed_stages(summary) == {name: name != stage for name in STAGES}
        assert_same_result(finished, undisturbed)


@pytest.mark.parametrize("how", ["empty", "cut in half", "last byte missing", "something else", "removed"])
def test_damaged_labels_and_depth_are_computed_again(
    finished: Path, sequence: Sequence, undisturbed: Path, how: str
) -> None:
    folder = RunFolder(finished)
    for path, stage in ((folder.labels, "tracks"), (folder.depth, "fusion")):
        if how == "removed":
            path.unlink()
        else:
            damage(path, how)
        summary, _ = run_sound(sequence, finished, quick(), resume=True)
        assert resumed_stages(summary) == {name: name != stage for name in STAGES}
        assert_same_result(finished, undisturbed)


def test_a_summary_is_there_only_after_a_complete_run(finished: Path, sequence: Sequence) -> None:
    folder = RunFolder(finished)
    assert folder.summary.exists()
    with pytest.raises(Cancelled):
        reconstruct(sequence, finished, quick("nonrigid.neighbors=3"), resume=True, should_stop=stop_at(10))
    assert not folder.summary.exists()
    run_sound(sequence, finished, quick(), resume=True)
    assert folder.summary.exists()


def test_files_of_others_are_left_alone(finished: Path, sequence: Sequence) -> None:
    theirs = [finished / name for name in (".tmp-0123abcd-notes.txt", ".tmp-mine", "notes.txt")]
    folders = [finished / ".tmp-0123abcd-depth.npy", finished / "clouds" / "other"]
    for path in theirs:
        path.write_text("keep")
    for folder in folders:
        folder.mkdir(parents=True)
    ours = [finished / ".tmp-0123abcd-labels.npz", finished / "stages" / ".tmp-89abcdef-nonrigid.npz"]
    ours += [finished / "clouds" / "dynamic" / ".tmp-89abcdef-00001.ply"]
    ours += [
        finished / "pictures" / ".tmp-0a0a0a0a-scene.png",
        finished / "stages/windows/.tmp-0a0a0a0a-scene_000000.npz",
    ]
    ours += [finished / "cues" / "depth" / "card-0123" / ".tmp-0a0a0a0a-0123.npy"]
    for path in ours:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("left by a killed run")
    reconstruct(sequence, finished, quick(), resume=True)
    assert all(path.exists() for path in theirs + folders)
    assert not any(path.exists() for path in ours)


def test_cancelling_anywhere_and_resuming_ends_the_same(
    tmp_path: Path, sequence: Sequence, undisturbed: Path, rng: np.random.Generator
) -> None:
    total = count_polls(sequence, tmp_path / "count")
    assert total > 20
    chosen = {1, 2, sequence.num_frames + 1, sequence.num_frames + 2, total}
    chosen |= set(rng.choice(total, 5, replace=False).tolist()) - {0}
    for poll in sorted(chosen):
        run_dir = tmp_path / f"poll-{poll}"
        with pytest.raises(Cancelled, match="stopped"):
            reconstruct(sequence, run_dir, quick(), should_stop=stop_at(poll))
        assert not RunFolder(run_dir).summary.exists()
        assert temporary_files(run_dir) == []
        run_sound(sequence, run_dir, quick(), resume=True)
        assert_same_result(run_dir, undisturbed)


@pytest.mark.slow
def test_cancelling_again_and_again_never_loses_a_finished_stage(
    tmp_path: Path, sequence: Sequence, undisturbed: Path
) -> None:
    done: set[str] = set()
    poll = 3
    while True:
        try:
            reconstruct(sequence, tmp_path / "run", quick(), resume=bool(done), should_stop=stop_at(poll))
        except Cancelled:
            stored = {path.stem for path in (tmp_path / "run" / "stages").glob("*.npz")}
            assert done <= stored
            # As early as can be once a stage is there, so that the next one is interrupted too.
            poll = poll + 1 if stored == done else 3
            done = stored
            continue
        break
    assert done == set(STAGES) - {"fusion"}
    check_run(tmp_path / "run", sequence)
    assert_same_result(tmp_path / "run", undisturbed)


def kill_runs(sequence: Sequence, config: Config, folder: Path, cases: list[str]) -> dict[str, int]:
    """Run and kill every case in processes of their own; return the signal that ended each."""
    pickled = folder / "job.pickle"
    pickled.write_bytes(pickle.dumps((sequence, config)))
    program = Path(__file__).with_name("pipeline_killed.py")
    done = subprocess.run(
        [sys.executable, str(program), str(pickled), str(folder), *cases],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return {name: int(number) for name, number in (line.split() for line in done.stdout.splitlines())}


@pytest.mark.skipif(sys.platform == "win32", reason="needs fork and SIGKILL")
def test_a_killed_run_resumes_to_the_same_result(
    tmp_path: Path, sequence: Sequence, undisturbed: Path, rng: np.random.Generator
) -> None:
    polls = rng.choice(np.arange(2, 20), 2, replace=False).tolist()
    seconds = rng.uniform(0.0, 0.4, 3).round(3).tolist()
    cases = (
        [f"write:{n}" for n in (1, 2, 4, 7, 8, 9, 11)]
        + [f"poll:{n}" for n in polls]
        + [f"seconds:{s}" for s in seconds]
    )
    ended_by = kill_runs(sequence, quick(), tmp_path, cases)
    assert len(ended_by) == len(cases)
    for name, number in ended_by.items():
        run_dir = tmp_path / name
        if not name.startswith("seconds"):
            assert number == signal.SIGKILL, name
            assert not RunFolder(run_dir).summary.exists()
        if name.startswith("write"):
            # Depth and how sure it is are written side by side, everything else alone.
            unfinished = {left.split("-", 2)[2] for left in temporary_files(run_dir)}
            assert len(unfinished) == 1 or unfinished == {"depth.npy", "confidence.npy"}
        run_sound(sequence, run_dir, quick(), resume=True)
        assert_same_result(run_dir, undisturbed)
