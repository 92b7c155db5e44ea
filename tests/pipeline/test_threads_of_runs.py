"""Threads of a run: any number gives the same bytes, and BLAS has one all the time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import SMALL, TINY, make_config, make_scene
from threadpoolctl import threadpool_info, threadpool_limits

from uni4d_fg.cues.gather import gather_cues
from uni4d_fg.cues.plan import plan_cues
from uni4d_fg.factors.state import State
from uni4d_fg.frontend.sequence.assemble import as_video
from uni4d_fg.frontend.sequence.model import GroundTruth
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.optim.stage import Stage
from uni4d_fg.optim.threads import thread_limit
from uni4d_fg.pipeline import control, fuse, reconstruct
from uni4d_fg.results.run_folder import RunFolder


def solved(run: RunFolder) -> dict[str, bytes]:
    """Return what a run has found, without the times that its stages took."""
    with np.load(run.reconstruction, allow_pickle=False) as stored:
        arrays = {name: stored[name].tobytes() for name in stored.files}
    return {**arrays, "depth": run.depth.read_bytes()}


def test_solvers_change_no_byte(tmp_path: Path) -> None:
    # Dense enough for sums in several parts, and noisy so that every stage has work to do.
    sequence = make_scene(SMALL, num_frames=12, grid_columns=40, grid_rows=30)
    found = []
    for threads in (1, 3):
        with thread_limit(threads):
            reconstruct(sequence, tmp_path / str(threads), make_config())
        found.append(solved(RunFolder(tmp_path / str(threads))))
    assert found[1] == found[0]
    assert len(found[0]) > 10


@pytest.mark.slow
def test_the_video_alone_changes_no_byte(tmp_path: Path) -> None:
    scene = make_synthetic_sequence(SyntheticSceneConfig(num_frames=24, seed=2, height=180, width=240, focal=220.0))
    bare = replace(as_video(scene), depths=None, masks=None, tracks=None, intrinsics=None, ground_truth=GroundTruth())
    found = []
    for threads in (1, 3):
        folder = tmp_path / str(threads)
        with thread_limit(threads):
            sequence, _ = gather_cues(bare, plan_cues(bare, bare=True), folder / "cues", make_config())
            reconstruct(sequence, folder / "run", make_config())
        found.append(solved(RunFolder(folder / "run")))
    assert found[1] == found[0]


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
