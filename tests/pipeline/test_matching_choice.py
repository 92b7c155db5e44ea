"""Whether frames have depth from several views: one choice for all, by most of those tried."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import TINY, make_config, make_scene

from uni4d_fg.optim.extension import find_extension
from uni4d_fg.pipeline import dense_maps, reconstruct
from uni4d_fg.results.fusion.matching_choice import bleeding_of, is_poor, is_preferred
from uni4d_fg.results.fusion.static_depth import HeldOut


def test_a_poor_cue_bleeds_and_is_matched_unless_far_worse() -> None:
    """A network's, by its noise, and depth between points of motion; whatever a few frames show of either."""
    assert [is_poor(0.05, None), is_poor(0.002, True), is_poor(0.02, None), is_poor(0.002, False)] == [
        True,
        True,
        False,
        False,
    ]
    assert bleeding_of(1.0, poor=False) == 0.0
    assert bleeding_of(7.0, poor=False) == 7.0
    sharp, poor = bleeding_of(np.nan, poor=False), bleeding_of(np.nan, poor=True)
    assert sharp == 0.0
    assert poor == 6.0
    for ratio, of_poor, of_other in ((0.9, True, True), (2.0, True, False), (3.5, False, False)):
        errors = HeldOut(0.01, ratio, True)
        assert is_preferred(errors, poor, poor=True) is of_poor
        assert is_preferred(errors, sharp, poor=False) is of_other
    assert is_preferred(HeldOut(0.01, 1.4, True), 7.0, poor=False)


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


@pytest.mark.skipif(find_extension()[0] is None, reason="needs the C++ extension")
@pytest.mark.parametrize(("depth_parallax", "all_or_none"), [(None, 0), (True, 8)])
def test_depth_between_landmarks_is_not_judged_by_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, depth_parallax: bool | None, all_or_none: int
) -> None:
    monkeypatch.setattr(dense_maps, "held_out_errors", lambda *_: HeldOut(0.01, 5.0, True))
    scene = dataclasses.replace(make_scene(TINY, num_frames=8), depth_parallax=depth_parallax)
    summary = reconstruct(scene, tmp_path / "run", make_config())
    assert summary.stages["fusion"]["matched_frames"] == all_or_none
