"""Files written beside the run: in order, none after one that failed, and all of them when it ends."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from pipeline_scenes import TINY, make_config, make_scene, run_sound

from uni4d_fg.errors import OutputError
from uni4d_fg.pipeline.store import StageRecord, StageStore
from uni4d_fg.pipeline.written_beside import WrittenBeside
from uni4d_fg.results.run_folder import RunFolder


def test_they_are_written_in_order_while_the_caller_goes_on() -> None:
    done: list[int] = []
    free = threading.Event()
    with WrittenBeside() as written:
        written.put(lambda: (free.wait(60), done.append(0))[1])
        for number in (1, 2, 3):
            written.put(lambda number=number: done.append(number))
        assert done == []  # the first still waits, and nothing waited for it
        free.set()
        written.wait()
        assert done == [0, 1, 2, 3]


def full() -> None:
    raise OutputError("no space left")


def test_nothing_is_written_after_what_failed_and_the_error_comes_out() -> None:
    done: list[int] = []

    def run() -> None:
        with WrittenBeside() as written:
            written.put(lambda: done.append(0))
            written.put(full)
            written.put(lambda: done.append(1))

    with pytest.raises(OutputError, match="no space left"):
        run()
    assert done == [0]


def test_the_next_hand_over_says_that_one_failed() -> None:
    written = WrittenBeside()
    written.put(full)
    with pytest.raises(OutputError, match="no space left"):
        written.wait()
    with pytest.raises(OutputError, match="no space left"):
        written.put(lambda: pytest.fail("a write was taken after one that failed"))
    written.__exit__(KeyError, KeyError(), None)  # what went wrong in the caller is not hidden


def test_an_interrupted_run_still_has_its_files() -> None:
    done: list[int] = []

    def run() -> None:
        with WrittenBeside() as written:
            written.put(lambda: done.append(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert done == [0]


def test_graphs_whose_record_comes_late_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save, discard = StageStore.save, StageStore.discard
    graph_is_there, next_has_begun = threading.Event(), threading.Event()

    def save_late(store: StageStore, name: str, key: str, record: StageRecord) -> None:
        if name == "camera_init":
            graph_is_there.set()
            assert next_has_begun.wait(60)
        save(store, name, key, record)

    def begin(store: StageStore, name: str) -> None:
        discard(store, name)
        if name == "bundle_adjustment":  # in windows it leaves graphs of the first stage too, and removes old ones
            assert graph_is_there.wait(60)
        if name == "nonrigid":
            next_has_begun.set()

    monkeypatch.setattr(StageStore, "save", save_late)
    monkeypatch.setattr(StageStore, "discard", begin)
    run_sound(make_scene(TINY, num_frames=4), tmp_path, make_config("bundle_adjustment.measure_noise=false"))
    for kind in ("camera_init", "bundle_adjustment", "nonrigid"):
        assert RunFolder(tmp_path).graph(kind).exists()
