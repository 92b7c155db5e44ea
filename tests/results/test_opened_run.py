from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from viewing_samples import NUM_FRAMES, copied, opened

from uni4d_fg.cli.runs import stored_input
from uni4d_fg.errors import InputError
from uni4d_fg.files import save_npy
from uni4d_fg.results.run import Run


def no_sequence() -> object:
    raise InputError("the sequence has moved")


def test_a_finished_run_opens_with_all_its_parts(finished_run: Path) -> None:
    run = opened(finished_run)
    assert run.num_frames == NUM_FRAMES
    assert run.name == "room"
    assert run.notes == ()
    assert run.is_metric
    assert run.labelled is not None
    assert run.depth is not None
    assert run.sequence is not None


def test_what_is_no_finished_run_is_one_clear_error(finished_run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        Run(tmp_path / "nosuch", no_sequence)
    with pytest.raises(InputError, match="holds no run"):
        Run(tmp_path, no_sequence)
    with pytest.raises(InputError, match="no such folder"):
        Run(finished_run / "summary.json", no_sequence)
    run = copied(finished_run, tmp_path)
    (run / "summary.json").write_text("[3")
    with pytest.raises(InputError, match=r"summary\.json"):
        Run(run, no_sequence)
    (run / "summary.json").write_text("[3]")
    with pytest.raises(InputError, match="no summary of a run"):
        Run(run, no_sequence)
    (run / "summary.json").unlink()
    with pytest.raises(InputError, match="--resume"):
        Run(run, no_sequence)


def test_what_is_missing_is_noted_and_left_out(finished_run: Path, tmp_path: Path) -> None:
    run = copied(finished_run, tmp_path)
    (run / "labels.npz").unlink()
    save_npy(run / "depth.npy", np.ones((NUM_FRAMES, 3, 4), np.float32))
    result = Run(run, no_sequence)
    assert (result.labelled, result.depth, result.sequence) == (None, None, None)
    assert len(result.notes) == 3
    assert "has moved" in result.notes[2]


def test_a_sequence_that_has_changed_is_not_shown(finished_run: Path) -> None:
    sequence = stored_input(finished_run).read()
    result = Run(finished_run, lambda: replace(sequence, image_size=(48, 64)))
    assert result.sequence is None
    assert "64x48" in result.notes[0]


def test_lengths_are_meters_unless_the_run_says_otherwise(finished_run: Path, tmp_path: Path) -> None:
    run = copied(finished_run, tmp_path)
    summary = json.loads((run / "summary.json").read_text())
    (run / "summary.json").write_text(json.dumps({**summary, "cues": {"metric": False}}))
    assert (opened(run).unit, opened(run).small_unit) == ("units", (1.0, "units"))
    assert (opened(finished_run).unit, opened(finished_run).small_unit) == ("m", (1000.0, "mm"))
