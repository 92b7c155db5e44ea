"""By how much a cue that bleeds is off for it is told beside edges, and nothing is on slanted planes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.results.fusion.bleeding import mixing_sigma

SHAPE = (60, 120)


def test_a_slanted_plane_is_not_mixed_to_the_border() -> None:
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    log_depth = -np.log(0.6 - 0.003 * u + 0.002 * v).astype(np.float32)
    assert mixing_sigma(log_depth, 9.0).max() < 1e-3
    assert not mixing_sigma(np.full(SHAPE, np.nan, np.float32), 9.0).any()


@pytest.mark.parametrize("jump", [0.1, 0.2, 0.4])
def test_the_error_beside_a_blurred_step_is_told(jump: float) -> None:
    """A step of inverse depth that was blurred by 4 px, with a hole far from it."""
    truth = np.where(np.arange(SHAPE[1]) < 60, 1.0, 1.0 - jump) * np.ones((SHAPE[0], 1))
    cue = -np.log(cv2.GaussianBlur(truth, (0, 0), 4.0)).astype(np.float32)
    error = np.abs(cue + np.log(truth))
    cue[20:40, 100:110] = np.nan
    sigma = mixing_sigma(cue, 9.0)
    near = slice(52, 68)
    told, true = (float(np.sqrt(np.mean(values[:, near] ** 2))) for values in (sigma, error))
    assert 0.5 < told / true < 2.0
    assert sigma[:, :35].max() < 0.01 * jump
    assert sigma[:, 90:].max() < 0.01 * jump
