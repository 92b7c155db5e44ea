"""Threads of a run: fusion on several gives the same bytes, and BLAS has one all the time."""

from __future__ import annotations

from pathlib import Path

import pytest
from pipeline_scenes import TINY, make_config, make_scene
from threadpoolctl import threadpool_info, threadpool_limits

from uni4d_fg.factors.state import State
from uni4d_fg.optim.stage import Stage
from uni4d_fg.pipeline import control, fuse, reconstruct
from uni4d_fg.results.run_folder import RunFolder


@pytest.mark.parametrize("broken", [[], [5]])
def test_threads_change_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: list[int]) -> None:
    sequence = make_scene(TINY, num_frames=9)
    monkeypatch.setattr(control, "contradicting_frames", lambda control, config: broken)
    stored = []
    for threads in (1, 4):
        monkeypatch.setattr(fuse, "thread_count", lambda count=threads: count)
        summary = reconstruct(sequence, tmp_path / str(threads), make_config())
        assert summary.stages["fusion"]["broken_frames"] == broken
        stored.append(RunFolder(tmp_path / str(threads)).depth.read_bytes())
    assert stored[1] == stored[0]


def test_blas_has_one_thread_in_the_whole_run(tmp_path: Path) -> None:
    seen: dict[str, int] = {}

    def look(stage: Stage, state: State) -> None:
        blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
        seen[stage.kind] = max(blas)

    def most() -> int:
        return max(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")

    with threadpool_limits(3, user_api="blas"):
        before = most()
        reconstruct(make_scene(TINY), tmp_path / "run", make_config(), additions=[look])
        assert most() == before
    assert {"camera_init", "bundle_adjustment", "nonrigid"} <= set(seen)
    assert set(seen.values()) == {1}
