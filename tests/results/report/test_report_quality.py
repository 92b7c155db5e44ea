from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from viewing_samples import opened

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.results.colors import instance_colors
from uni4d_fg.results.depth_agreement import depth_disagreement
from uni4d_fg.results.report.certainty import certainty
from uni4d_fg.results.report.depth import depth_strips
from uni4d_fg.results.report.markup import table
from uni4d_fg.results.report.masks import mask_picture, mask_strip
from uni4d_fg.results.report.views import scene_views
from uni4d_fg.results.run import Run


@pytest.fixture(scope="module")
def run(finished_run: Path) -> Run:
    return opened(finished_run)


def alternatives(page: str) -> list[str]:
    return re.findall(r'<img [^>]*alt="(.*?)"', page)


def with_start(run: Run, **start: object) -> Run:
    cues = {"metric": False, "warnings": [], "sources": {}, "facts": [], "start": start}
    return run.with_parts(summary={**run.summary, "cues": cues})


def test_the_strip_of_masks_says_how_much_is_masked(run: Run) -> None:
    assert run.sequence is not None
    assert run.sequence.masks is not None
    found = mask_strip(run)
    said = [re.fullmatch(r"Masks of frame (\d+): (.*), ([\d.]+) % of the picture", a) for a in alternatives(found)]
    assert len(said) == 5
    for match in said:
        assert match is not None
        mask = run.sequence.masks[int(match[1])]
        assert float(match[3]) == pytest.approx(100 * np.mean(mask > 0), abs=0.051)
    instances = {int(i) for match in said if match for i in np.unique(run.sequence.masks[int(match[1])]) if i}
    assert instances
    for instance in instances:
        count = int((run.reconstruction.dynamic_instance == instance).sum())
        assert f"instance {instance}: {count} trajector" in found


def test_a_mask_is_tinted_where_it_is_and_nowhere_else() -> None:
    image = np.full((60, 80, 3), 100, np.uint8)
    mask = np.zeros((60, 80), np.int32)
    mask[10:30, 20:50] = 3
    out = mask_picture(image, mask, 80)
    color = instance_colors(np.array([3]))[0].astype(float)
    assert np.abs(out[20, 35] - (0.45 * 100 + 0.55 * color)).max() <= 1
    changed = (out != image).any(axis=2)
    assert changed[10:30, 20:50].all()
    assert not changed[:8].any()
    assert not changed[:, 55:].any()
    assert mask_picture(image, mask, 40).shape == (30, 40, 3)


def test_views_show_the_scene_from_several_sides(run: Run) -> None:
    found = scene_views(run)
    assert len(alternatives(found)) == 4
    assert len(set(re.findall(r'src="(.*?)"', found))) == 4
    points = re.search(r"static cloud \(([\d,]+) points\)", found)
    assert points is not None
    assert int(points[1].replace(",", "")) > 1000
    gone = InputError("gone")
    bare = run.with_parts(sequence=gone, depth=gone)
    assert bare.folder.static_cloud.is_file()
    assert len(alternatives(scene_views(bare))) == 4


def test_depth_that_agrees_and_depth_that_does_not(run: Run) -> None:
    assert run.sequence is not None
    assert run.sequence.masks is not None
    truth = run.sequence.ground_truth
    assert truth.depths is not None
    assert truth.world_T_cam is not None
    exact = replace(run.reconstruction, world_T_cam=truth.world_T_cam, intrinsics=truth.intrinsics)
    pairs = [(0, 4), (2, 6)]
    assert np.median(depth_disagreement(truth.depths, exact, run.sequence.masks, pairs)) < 0.01
    scaled = np.zeros(run.num_frames)
    scaled[4:] = np.log(1.1)
    off = depth_disagreement(truth.depths, exact, run.sequence.masks, pairs, scaled)
    assert np.median(off) == pytest.approx(np.log(1.1), rel=0.05)
    nowhere = ArrayFrames(np.full((run.num_frames, *run.reconstruction.image_size), np.nan, np.float32))
    assert len(depth_disagreement(nowhere, exact, None, pairs)) == 0


def test_the_quality_of_depth_is_said(run: Run) -> None:
    found = depth_strips(run)
    known = re.search(r"known for ([\d.]+) % of the pixels", found)
    assert known is not None
    assert run.depth is not None
    assert float(known[1]) == pytest.approx(100 * np.mean([np.isfinite(d).mean() for d in run.depth]), abs=2.0)
    fused = re.search(r"fused depth by ([\d.]+) %", found)
    cue = re.search(r"cue depth by ([\d.]+) %", found)
    assert fused is not None
    assert cue is not None
    assert 0 < float(fused[1]) <= float(cue[1])


def test_what_motion_leaves_open_is_said(run: Run) -> None:
    narrow = certainty(with_start(run, focal_px=500.0, focal_interval_px=[495.0, 506.0], focal_is_open=[False, False]))
    assert "fixes the focal length at 500 px: outside of 495 to 506 px" in narrow
    assert "sides that are" not in narrow
    for parallax, verdict in ((8.9, "that is little"), (9.1, "enough to tell its path")):
        told = certainty(with_start(run, parallax_px=parallax, noise_px=0.3))
        assert f"from sides that are {parallax} px apart in the image, beside 0.30 px of noise ({verdict}" in told
    wide = certainty(
        with_start(
            run,
            focal_px=500.0,
            focal_interval_px=[350.0, 900.0],
            focal_is_open=[False, True],
            stretch_along_view=[0.7, 1.8],
            unexplained=0.7,
            starts=[{"first": 0, "second": 9, "degrees": 31.0, "degrees_per_frame": 1.5, "unexplained": 0.71}],
        )
    )
    assert "everything from 350 px to any longer one" in wide
    assert "by -30 to +80 %" in wide
    assert "explain 30 % of the tracks" in wide
    assert "cameras are ambiguous" in wide
    assert "turned by 31 degrees" in wide
    assert "0 and 9" in wide
    same = certainty(with_start(run, starts=[{"first": 0, "second": 9, "degrees": 0.4}]))
    assert "1 other start of the search that explained the tracks nearly as well gave the same cameras" in same
    assert "Lengths have no unit" in same
    plain = certainty(run)
    assert "focal length" not in plain
    assert "as long as the depth cue says" in plain


def test_covariances_are_said_in_plain_words(run: Run) -> None:
    covariance = np.zeros((run.num_frames, 6, 6))
    covariance[1:, range(6), range(6)] = np.array([0.01**2] * 3 + [0.002**2] * 3) / 3.0
    covariance[5, 3:, 3:] *= 100.0
    found = certainty(run.with_parts(reconstruction=replace(run.reconstruction, pose_covariance=covariance)))
    assert "position is typically off by about 2 mm" in found
    assert f"an orientation by {np.degrees(0.01):.2g} degrees" in found
    assert "The least certain is frame 5, with 20 mm" in found
    assert "well determined" in found
    covariance[1:, 3:, 3:] = np.eye(3)
    found = certainty(run.with_parts(reconstruction=replace(run.reconstruction, pose_covariance=covariance)))
    assert "poorly determined" in found
    found = certainty(run.with_parts(reconstruction=replace(run.reconstruction, pose_covariance=None)))
    assert "not known: the run has no covariances" in found


def test_long_tables_are_folded() -> None:
    rows = [[str(row), "x"] for row in range(30)]
    assert table("short", ("a", "b"), rows[:5]).startswith("<div")
    folded = table("long", ("a", "b"), rows)
    assert folded.startswith("<details><summary>long (30 rows)</summary>")
    assert folded.count("<tr>") == 31
