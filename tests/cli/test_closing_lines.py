"""What is said at the end of a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from uni4d_fg.cli.console import duration
from uni4d_fg.cli.reconstruction import closing_lines
from uni4d_fg.counted import counted
from uni4d_fg.pipeline.summary import RunSummary


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0.04, "0.0 s"), (59.94, "59.9 s"), (60.0, "1 min 0 s"), (187.4, "3 min 7 s"), (4330.0, "1 h 12 min")],
)
def test_durations_are_said_as_a_person_would(seconds: float, said: str) -> None:
    assert duration(seconds) == said


def test_the_end_of_a_run_says_how_long_how_large_and_what_next(tmp_path: Path) -> None:
    run = tmp_path / "my run"
    (run / "stages").mkdir(parents=True)
    (run / "depth.npy").write_bytes(bytes(2_500_000))
    (run / "stages" / "a.npz").write_bytes(bytes(1_500_000))
    total, results, following = closing_lines(run, 61.0)
    assert total == "total: 1 min 1 s, 4 MB on disk"
    assert results == f"results: {run}"
    assert f"uni4d-fg view '{run}'" in following


def test_the_time_of_the_cues_is_part_of_what_is_said() -> None:
    cues = {"sources": {"depth": "a network"}, "facts": [], "seconds": 83.25}
    lines = RunSummary({"name": "clip", "num_frames": 3}, cues=cues).lines()
    assert "cues: depth a network; 83.2 s" in lines


@pytest.mark.parametrize(("number", "said"), [(0, "0 boxes"), (1, "1 box"), (2, "2 boxes")])
def test_numbers_agree_with_their_nouns(number: int, said: str) -> None:
    assert counted(number, "box", "boxes") == said
