"""Streams into a folder: interrupted, killed and resumed they end as if nothing had happened."""

from __future__ import annotations

import json
import pickle
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from stream_samples import feed, stream_config
from stream_samples import stream as stream_of
from typer.testing import CliRunner

from uni4d_fg.cli.main import application
from uni4d_fg.cues.scale_notes import NOT_METRIC_GIVEN
from uni4d_fg.errors import Cancelled, InputError, OutputError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.trajectory_files import read_tum
from uni4d_fg.pipeline.stream import stream_sequence
from uni4d_fg.pipeline.stream_checkpoint import restore, state_arrays
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.slam.incremental import IncrementalReconstructor

FRAMES = 30
CONFIG = stream_config(
    "incremental.window=6", "incremental.nonrigid_lag=4", "incremental.nonrigid_window=7",
    "incremental.keyframe_parallax=0.006", "incremental.checkpoint_interval=7",
)  # fmt: skip
FEW = {"grid_columns": 14, "grid_rows": 10}
"""Tracks enough for a stream that is compared with itself."""
KILLED = Path(__file__).with_name("stream_killed.py")


def stream(num_frames: int, **changes: Any) -> Sequence:
    return stream_of(num_frames, **(FEW | changes))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    summary = stream_sequence(stream(FRAMES), folder, CONFIG)
    assert summary.num_frames == FRAMES
    assert sum(summary.counts.values()) == FRAMES
    return folder


def test_lengths_are_in_the_unit_of_the_depth(tmp_path: Path) -> None:
    for metric in (True, False):
        given = replace(stream(8), depth_is_metric=metric)
        found = stream_sequence(given, tmp_path / str(metric), CONFIG).to_dict()
        assert found["cues"] == {"metric": metric}
        assert (NOT_METRIC_GIVEN in found["warnings"]) is not metric


def test_frames_that_are_too_far_at_the_start_lack_depth(tmp_path: Path) -> None:
    given = stream(8)
    far, nothing = (
        replace(given, depths=[np.full_like(given.depths[0], value), *(given.depths[t] for t in range(1, 8))])
        for value in (500.0, np.nan)
    )
    for name, sequence in (("far", far), ("nothing", nothing)):
        stream_sequence(sequence, tmp_path / name, CONFIG)
    assert_same(tmp_path / "far", tmp_path / "nothing")


def test_a_principal_point_outside_the_image_is_said_before_a_run_is_touched(tmp_path: Path) -> None:
    given = stream(8)
    with pytest.raises(InputError, match="principal point"):
        stream_sequence(replace(given, intrinsics=given.intrinsics * [1, 1, 10, 1]), tmp_path / "run", CONFIG)
    assert not (tmp_path / "run").exists()


def assert_same(folder: Path, expected: Path) -> None:
    """Assert that two streams hold the same reconstruction, number by number."""
    found, wanted = (load_reconstruction(f / "reconstruction.npz") for f in (folder, expected))
    for name in found.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
    np.testing.assert_array_equal(
        read_tum(folder / "trajectory.tum").world_T_cam, read_tum(expected / "trajectory.tum").world_T_cam
    )
    assert not list(folder.rglob(".tmp-*"))


def stream_stage(folder: Path) -> dict[str, Any]:
    """What the summary of a run says of the stream."""
    return dict(json.loads((folder / "summary.json").read_text())["stages"]["stream"])


def assert_in_order(trajectory: Path) -> None:
    """Assert that a trajectory that is still being written has every frame once."""
    lines = trajectory.read_text().splitlines() if trajectory.exists() else []
    timestamps = [float(line.split()[0]) for line in lines]
    assert timestamps == sorted(set(timestamps))


@pytest.mark.parametrize("stop_before", [0, 3, 16, 29])
def test_an_interrupted_stream_goes_on_where_it_was(tmp_path: Path, undisturbed: Path, stop_before: int) -> None:
    polls = iter(range(FRAMES + 1))
    with pytest.raises(Cancelled, match=f"before frame {stop_before}"):
        stream_sequence(stream(FRAMES), tmp_path, CONFIG, should_stop=lambda: next(polls) == stop_before)
    with np.load(tmp_path / "stages" / "stream.npz") as stored:
        seconds = dict(zip(stored["seconds_part"].tolist(), stored["seconds"].tolist(), strict=True))
    summary = stream_sequence(stream(FRAMES), tmp_path, CONFIG, resume=True)
    assert summary.resumed_from == stop_before
    assert_same(tmp_path, undisturbed)
    assert summary.counts == stream_stage(undisturbed)["counts"]
    assert "total" in seconds
    assert all(summary.seconds[part] >= value for part, value in seconds.items())
    assert summary.seconds["total"] > seconds["total"]
    assert stream_stage(tmp_path)["seconds"] == summary.seconds


@pytest.mark.parametrize("refine", ["on", "off"])
def test_an_interrupted_stream_goes_on_with_the_points_that_it_followed(tmp_path: Path, refine: str) -> None:
    """The velocities tell where points are looked for, the first views where they are found."""
    config = CONFIG.model_copy(update={"tracking": CONFIG.tracking.model_copy(update={"refine": refine})})
    sequence = replace(stream_of(14, render_images=True, objects="none"), tracks=None)
    stream_sequence(sequence, tmp_path / "undisturbed", config)
    polls = iter(range(14))
    with pytest.raises(Cancelled):
        stream_sequence(sequence, tmp_path / "run", config, should_stop=lambda: next(polls) == 9)
    stream_sequence(sequence, tmp_path / "run", config, resume=True)
    assert_same(tmp_path / "run", tmp_path / "undisturbed")


def test_a_killed_stream_goes_on_from_its_last_checkpoint(
    tmp_path: Path, undisturbed: Path, rng: np.random.Generator
) -> None:
    work = tmp_path / "work.pickle"
    work.write_bytes(pickle.dumps((stream(FRAMES), CONFIG)))
    moments = [f"frame:{rng.integers(1, 8)}", f"frame:{rng.integers(8, 15)}", "write:2", f"write:{rng.integers(3, 7)}"]
    folder = tmp_path / "run"
    program = [sys.executable, str(KILLED), str(work), str(folder), *moments]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for moment in moments:
            process.stdin.write("go\n")
            process.stdin.flush()
            assert process.stdout.readline() == f"{signal.SIGKILL.value}\n", f"not killed at {moment}"
            assert_in_order(folder / "trajectory.tum")
    assert process.returncode == 0
    stream_sequence(stream(FRAMES), folder, CONFIG, resume=True)
    assert_same(folder, undisturbed)


def test_poses_are_on_disk_as_frames_leave_the_window(tmp_path: Path) -> None:
    lines: list[int] = []

    def count(_: object) -> None:
        path = tmp_path / "trajectory.tum"
        lines.append(len(path.read_text().splitlines()) if path.exists() else 0)

    stream_sequence(stream(FRAMES), tmp_path, CONFIG, on_frame=count)
    assert lines[0] == 0
    assert lines[-1] > 5
    assert (np.diff(lines) >= 0).all()


def test_a_checkpoint_of_another_configuration_is_refused(tmp_path: Path) -> None:
    polls = iter(range(FRAMES))
    with pytest.raises(Cancelled):
        stream_sequence(stream(FRAMES), tmp_path, CONFIG, should_stop=lambda: next(polls) == 5)
    with pytest.raises(InputError, match="another configuration"):
        stream_sequence(stream(FRAMES), tmp_path, stream_config(), resume=True)
    (tmp_path / "stages" / "stream.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"stream\.npz"):
        stream_sequence(stream(FRAMES), tmp_path, CONFIG, resume=True)


@pytest.mark.parametrize("name", ["trajectory.tum", "stages/stream.npz"])
def test_a_folder_in_the_place_of_an_earlier_result_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir(parents=True)
    with pytest.raises(OutputError, match=f"cannot write .*{name}"):
        stream_sequence(stream(3), tmp_path, CONFIG)


def test_the_verb(tmp_path: Path) -> None:
    write_native(stream(10, objects="none"), tmp_path / "seq")
    run = tmp_path / "run"
    words = ["stream", str(tmp_path / "seq"), "--out", str(run), "--quiet"]
    result = CliRunner().invoke(application(), words)
    assert result.exit_code == 0, result.output
    assert "10 frames" in result.output
    whole = stream_stage(run)["counts"]
    assert sum(whole.values()) == 10
    resumed = CliRunner().invoke(application(), [*words, "--resume"])
    assert resumed.exit_code == 0, resumed.output
    assert f"10 frames ({', '.join(f'{count} {status}' for status, count in whole.items())})" in resumed.output
    assert stream_stage(run)["counts"] == whole
    assert "frames a second" in result.output
    assert load_reconstruction(run / "reconstruction.npz").num_frames == 10
    assert CliRunner().invoke(application(), words).exit_code != 0
    again = CliRunner().invoke(application(), [*words, "--overwrite"])
    assert again.exit_code == 0, again.output


def test_the_verb_on_a_bare_video(tmp_path: Path) -> None:
    sequence, video = stream(8, objects="none", render_images=True), tmp_path / "alone.mp4"
    write_native(sequence, tmp_path / "seq")
    height, width = sequence.image_size
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (width, height))
    for image in sequence.images:
        writer.write(image[:, :, ::-1])
    writer.release()
    words = ["stream", str(video), "--quiet", "--out", str(tmp_path / "run")]
    refused = CliRunner().invoke(application(), words)
    assert refused.exit_code != 0
    assert "has no depth" in str(refused.exception or refused.output)
    assert not (tmp_path / "run").exists()
    depth = next(path for path in (tmp_path / "seq").iterdir() if path.name.startswith("depth_cue"))
    result = CliRunner().invoke(application(), [*words, "--depth", str(depth)])
    assert result.exit_code == 0, result.output
    assert load_reconstruction(tmp_path / "run" / "reconstruction.npz").num_frames == 8


def test_a_restored_state_is_the_stored_one_in_every_array() -> None:
    solver, _ = feed(stream(FRAMES), CONFIG, frames=list(range(12)))
    stored = state_arrays(solver)
    sequence = stream(FRAMES)
    again = IncrementalReconstructor(sequence.intrinsics, sequence.image_size, CONFIG)
    restore(again, stored)
    found = state_arrays(again)
    assert found.keys() == stored.keys()
    for name, array in stored.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
    del stored["window_noise"]
    with pytest.raises(InputError, match="damaged"):
        restore(again, stored)


@pytest.mark.parametrize("fast", [True, False])
def test_points_are_followed_on_as_they_were(monkeypatch: pytest.MonkeyPatch, fast: bool) -> None:
    """With and without the C++ extension points are followed in two ways; a stream keeps to its own."""
    sequence = stream_of(4, render_images=True, objects="none")

    def solver(is_fast: bool) -> IncrementalReconstructor:
        monkeypatch.setattr("uni4d_fg.frontend.tracks.first_views.is_fast", lambda: is_fast)
        return IncrementalReconstructor(sequence.intrinsics, sequence.image_size, CONFIG)

    first = solver(fast)
    for t in range(3):
        first.add_frame(sequence.images[t], sequence.depths[t], sequence.masks[t])
    assert (first.tracker.followed.views is not None) is fast
    again = solver(not fast)
    restore(again, state_arrays(first))
    assert (again.tracker.followed.views is not None) is fast
    for one in (first, again):
        one.add_frame(sequence.images[3], sequence.depths[3], sequence.masks[3])
    np.testing.assert_array_equal(again.tracker.followed.points, first.tracker.followed.points)
    np.testing.assert_array_equal(again.window.pose, first.window.pose)
