"""Static depth at the size of the image: smooth within surfaces, sharp at edges."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.fusion.lifting import lifted
from uni4d_fg.results.fusion.multiview.working_frame import WorkingSize

SIZE = WorkingSize(30, 40, (120, 160))


def scene(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True depth (H, W) with an edge between working pixels, a cue that is noisy and 20 % too near, and its log."""
    u = np.arange(160)
    truth = (np.where(u < 82, 2.0 + 0.002 * u, 3.0) * np.ones((120, 1))).astype(np.float32)
    cue = (truth / 1.2 * np.exp(0.01 * rng.standard_normal(truth.shape))).astype(np.float32)
    return truth, cue, np.log(SIZE.depth(cue))


def test_surfaces_are_smooth_and_edges_are_where_the_cue_has_them(rng: np.random.Generator) -> None:
    truth, cue, log_cue = scene(rng)
    exact = np.log(SIZE.depth(truth))
    error = np.abs(lifted(exact, log_cue, cue, SIZE) / truth - 1)
    assert error[:, :70].max() < 2e-3
    assert error[:, 90:].max() < 1e-3
    assert error[:, 76:90].mean() < 0.02  # one frame's noise
    assert error.max() < 0.06


def test_missing_depth_takes_the_usual_change_and_a_missing_cue_stays_missing(rng: np.random.Generator) -> None:
    truth, cue, log_cue = scene(rng)
    exact = np.log(SIZE.depth(truth))
    exact[10:14, 20:30] = np.nan
    cue[100:110, 30:50] = np.nan
    depth = lifted(exact, log_cue, cue, SIZE)
    np.testing.assert_array_equal(np.isnan(depth), np.isnan(cue))
    assert np.nanmax(np.abs(depth / truth - 1)) < 0.06
    nothing = lifted(np.full_like(exact, np.nan), log_cue, cue, SIZE)
    assert np.isnan(nothing).all()
