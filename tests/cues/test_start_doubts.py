"""What a run says of cameras from motion alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cues.camera_scenes import FRAMES, structure
from cues.start_scenes import sideways, tracked

from uni4d_fg.cues.start_doubts import start_doubts, start_summary
from uni4d_fg.cues.structure.motion import Structure


@pytest.fixture(scope="module")
def found() -> Structure:
    """Return cameras of a path that leaves no doubt, of tracks with 0.3 px of noise."""
    return structure(tracked(sideways(FRAMES)), "camera.model=pinhole", "camera.zoom=off")


def test_parallax_is_that_of_the_median_track_that_has_a_point(found: Structure) -> None:
    position, angle = np.ones((5, 3)), np.array([0.01, 0.5, 0.02, 0.04, 0.9])
    position[[1, 4]] = np.nan
    few = replace(found, points=replace(found.points, position=position, angle=angle))
    assert few.parallax_px == pytest.approx(0.02 * np.mean(found.intrinsics[:2]))
    none = replace(found, points=replace(found.points, position=np.full((5, 3), np.nan), angle=angle))
    assert none.parallax_px == 0.0


def test_little_parallax_is_told(found: Structure) -> None:
    assert found.sigma_px == pytest.approx(0.3, rel=0.2)
    assert found.parallax_px > 60 * found.sigma_px
    assert start_doubts(found) == []
    (doubt,) = start_doubts(replace(found, sigma_px=found.parallax_px / 29.0))
    assert f"median parallax is {found.parallax_px:.1f} px" in doubt
    assert start_doubts(replace(found, sigma_px=found.parallax_px / 31.0)) == []
    (doubt,) = start_doubts(replace(found, denied_px=float("inf")))
    assert "distortion that no lens has: the cameras" in doubt
    summary = start_summary(found)
    assert (summary["parallax_px"], summary["noise_px"]) == (found.parallax_px, found.sigma_px)
