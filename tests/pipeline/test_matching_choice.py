"""Whether frames have depth from several views: one choice for all, by most of those tried."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from pipeline_scenes import TINY, make_config, make_scene

from uni4d_fg.optim.extension import find_extension
from uni4d_fg.pipeline import dense_maps, reconstruct
from uni4d_fg.results.fusion.static_depth import HeldOut


@pytest.mark.skipif(find_extension()[0] is None, reason="needs the C++ extension")
@pytest.mark.parametrize(("tried", "all_or_none"), [((0.8, 1.2, 0.9), 8), ((0.8, 1.2, 1.1), 0)])
def test_most_of_the_tried_frames_decide_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tried: tuple[float, ...], all_or_none: int
) -> None:
    # The first look at the middle frame, those that are tried, and then frames that would choose in turn.
    ratios = itertools.chain((1.0,), tried, itertools.cycle((0.5, 2.0)))
    monkeypatch.setattr(dense_maps, "held_out_errors", lambda *_: HeldOut(0.01, next(ratios), True))
    monkeypatch.setattr(dense_maps, "bleeding_radius", lambda *_: 0.0)
    summary = reconstruct(make_scene(TINY, num_frames=8), tmp_path / "run", make_config())
    assert summary.stages["fusion"]["broken_frames"] == []
    assert summary.stages["fusion"]["matched_frames"] == all_or_none
