from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.tracks.transfer import transfer

SIZE = (480, 640)
FOCAL = 550.0


def pixels(points: FloatArray, angle: float, center: FloatArray) -> FloatArray:
    """Project points (N, 3) into a camera at a center (3,) that is turned about its y axis, rad."""
    c, s = np.cos(angle), np.sin(angle)
    x = (points - center) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return FOCAL * x[:, :2] / x[:, 2:] + np.array([320.0, 240.0])


def views(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A cloud between 2 and 6 m in three views of a camera that moves and turns, (N, 2) px each."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (600, 3))
    before, seen, now = (pixels(points, 0.004 * t, np.array([0.01, 0.002, 0.004]) * t) for t in (0.0, 8.0, 24.0))
    return before, seen, now


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_parallax_of_the_past_predicts_where_points_are(seed: int) -> None:
    before, seen, now = views(seed)
    followed = np.arange(len(seen)) >= 200
    wanted = ~followed
    rng = np.random.default_rng(seed)
    target = now + rng.normal(0, 0.1, now.shape)
    target[500:] += np.array([30.0, -12.0])  # a quarter of them moves by itself
    displacement = seen - before
    warp, sigma = transfer(
        seen[followed], displacement[followed], target[followed], seen[wanted], displacement[wanted], SIZE
    )
    blind, blind_sigma = transfer(seen[followed], None, target[followed], seen[wanted], None, SIZE)
    error, other = (np.linalg.norm(w[:, :2] - now[wanted], axis=1) for w in (warp, blind))
    assert np.median(error) < 0.5
    assert np.median(other) > 5 * np.median(error)
    assert (error < 3 * sigma).mean() > 0.9
    assert (other < 3 * blind_sigma).mean() > 0.9


def test_the_affine_part_is_the_derivative() -> None:
    before, seen, now = views(3)
    at, moved = seen[:50], (seen - before)[:50]
    warp, _ = transfer(seen, seen - before, now, at, moved, SIZE)
    step = np.array([0.01, -0.02])
    shifted, _ = transfer(seen, seen - before, now, at + step, moved, SIZE)
    np.testing.assert_allclose(
        shifted[:, :2] - warp[:, :2], np.einsum("nij,j->ni", warp[:, 2:].reshape(-1, 2, 2), step), atol=1e-4
    )
