"""Fusion on several threads: the same bytes, with and without a frame whose cue is broken."""

from __future__ import annotations

from pathlib import Path

import pytest
from pipeline_scenes import TINY, make_config, make_scene

from uni4d_fg.pipeline import fuse, reconstruct
from uni4d_fg.results.run_folder import RunFolder


@pytest.mark.parametrize("broken", [[], [5]])
def test_threads_change_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: list[int]) -> None:
    sequence = make_scene(TINY, num_frames=9)
    monkeypatch.setattr(fuse, "contradicting_frames", lambda control, config: broken)
    stored = []
    for threads in (1, 4):
        monkeypatch.setattr(fuse, "thread_count", lambda count=threads: count)
        summary = reconstruct(sequence, tmp_path / str(threads), make_config())
        assert summary.stages["fusion"]["broken_frames"] == broken
        stored.append(RunFolder(tmp_path / str(threads)).depth.read_bytes())
    assert stored[1] == stored[0]
