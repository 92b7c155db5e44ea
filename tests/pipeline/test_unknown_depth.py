"""Depth that was assumed, as the camera stays in one place: nothing that follows speaks of its accuracy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import SMALL, make_config, make_scene

from uni4d_fg.pipeline import reconstruct
from uni4d_fg.results.export.run import export_run
from uni4d_fg.results.fusion.told_error import _FROM_MOTION, _SURENESS
from uni4d_fg.results.report.certainty import certainty
from uni4d_fg.results.run import Run

pytest.importorskip("open3d")


@pytest.mark.parametrize("saw_parallax", [False, True])
def test_a_run_its_report_and_its_exports_say_it(tmp_path: Path, saw_parallax: bool) -> None:
    sequence = replace(make_scene(SMALL, path="static"), depth_parallax=saw_parallax)
    summary = reconstruct(sequence, tmp_path / "run", make_config())
    assert not any("cue alone" in text for text in summary.warnings)
    facts = " ".join(summary.stages["fusion"]["facts"])
    assert ("a distance was assumed" in facts) is not saw_parallax
    assert ("depth_error" in summary.stages["fusion"]) is saw_parallax
    assert ("static depth is off by some" in facts) is saw_parallax
    run = Run(tmp_path / "run", lambda: sequence)
    if saw_parallax:  # as far off as pixels that are so sure, and as landmarks whose rays tell no depth at all
        still = np.stack([mask == 0 for mask in sequence.masks])
        sure = np.load(run.folder.confidence)[still] / 255.0
        usual = float(np.hypot(np.interp(sure, _SURENESS, _FROM_MOTION), np.sqrt(2 / np.pi)).mean())
        assert summary.stages["fusion"]["depth_error"] == pytest.approx(usual, rel=0.05)
    assert ("Nothing is known of depth" in str(certainty(run))) is not saw_parallax
    (exported,) = export_run(run, ["colmap"], tmp_path / "exported")
    assert ("at an assumed distance" in " ".join(exported.warnings)) is not saw_parallax
