"""What a run reports while it works, and how soon it stops when asked to."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import pytest
from pipeline_scenes import TINY, make_config, make_scene, run_sound, stop_at

from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline import reconstruct

pytest.importorskip("open3d")

TASKS = [
    "tracks",
    "rolling shutter",
    "lens",
    "camera init",
    "bundle adjustment",
    "nonrigid",
    "fusion",
    "clouds and pictures",
]


class Recorder:
    """Keeps what was reported, in order."""

    def __init__(self) -> None:
        self.events: list[tuple[str, str | int]] = []

    def begin(self, task: str, total: int | None) -> None:
        self.events.append(("begin", task))

    def advance(self, done: int, text: str = "") -> None:
        self.events.append(("advance", done))

    def end(self, text: str = "") -> None:
        self.events.append(("end", text))


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return make_scene(TINY)


def tasks_of(events: list[tuple[str, str | int]]) -> list[tuple[str, list[int]]]:
    """Return every task with what it advanced to; assert that tasks do not overlap and all end."""
    out: list[tuple[str, list[int]]] = []
    running = False
    for kind, value in events:
        if kind == "begin":
            assert not running
            out.append((str(value), []))
        else:
            assert running
        if kind == "advance":
            out[-1][1].append(int(value))
        running = kind != "end"
    assert not running
    return out


def test_every_task_begins_advances_and_ends_in_order(tmp_path: Path, sequence: Sequence) -> None:
    recorder = Recorder()
    run_sound(sequence, tmp_path, reporter=recorder)
    tasks = tasks_of(recorder.events)
    assert [name for name, _ in tasks] == TASKS
    for name, steps in tasks:
        assert steps == sorted(steps), name
    advanced = dict(tasks)
    assert advanced["fusion"] == list(range(1, sequence.num_frames + 1))
    for name in ("camera init", "bundle adjustment", "nonrigid"):
        assert advanced[name] == list(range(1, len(advanced[name]) + 1))
        assert len(advanced[name]) > 1


def test_resumed_stages_are_not_reported(tmp_path: Path, sequence: Sequence) -> None:
    run_sound(sequence, tmp_path)
    recorder = Recorder()
    run_sound(sequence, tmp_path, make_config("nonrigid.neighbors=3"), resume=True, reporter=recorder)
    assert [name for name, _ in tasks_of(recorder.events)] == ["nonrigid", "fusion", "clouds and pictures"]


def test_the_text_of_a_solve_names_it_and_its_energy(tmp_path: Path, sequence: Sequence) -> None:
    texts: list[str] = []

    class Texts(Recorder):
        def advance(self, done: int, text: str = "") -> None:
            texts.append(text)

    run_sound(sequence, tmp_path, reporter=Texts())
    assert any(text.startswith("camera_init[0-1]: energy ") for text in texts)
    assert any(text.startswith("bundle_adjustment: energy ") for text in texts)


@pytest.mark.parametrize("poll", [1, 4, 8, 12, 20, 30])
def test_cancellation_ends_the_run_within_a_few_questions(tmp_path: Path, sequence: Sequence, poll: int) -> None:
    asked = 0
    stop = stop_at(poll)

    def should_stop() -> bool:
        nonlocal asked
        asked += 1
        return stop()

    with pytest.raises(Cancelled, match="stopped"):
        reconstruct(sequence, tmp_path, make_config(), should_stop=should_stop)
    assert poll <= asked <= poll + 3


def test_the_pipeline_asks_often(tmp_path: Path, sequence: Sequence) -> None:
    times = [time.perf_counter()]

    def should_stop() -> bool:
        times.append(time.perf_counter())
        return False

    began = time.perf_counter()
    reconstruct(sequence, tmp_path, make_config("output.clouds=true"), should_stop=should_stop)
    longest = max(later - earlier for earlier, later in itertools.pairwise(times))
    assert longest < 0.5 * (time.perf_counter() - began)
    assert len(times) > 40


def test_cancelling_among_the_clouds(tmp_path: Path, sequence: Sequence) -> None:
    recorder = Recorder()

    def should_stop() -> bool:
        return (tmp_path / "clouds" / "dynamic" / "00002.ply").exists()

    with pytest.raises(Cancelled, match="stopped among the clouds"):
        reconstruct(
            sequence, tmp_path, make_config("output.clouds=true"), should_stop=should_stop, reporter=recorder
        )  # fmt: skip
    written = sorted(path.name for path in (tmp_path / "clouds" / "dynamic").iterdir())
    assert written == ["00000.ply", "00001.ply", "00002.ply"]
    assert not (tmp_path / "summary.json").exists()
    assert recorder.events[-1] == ("begin", "clouds and pictures")
