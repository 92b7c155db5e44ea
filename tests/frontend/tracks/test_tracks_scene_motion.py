from __future__ import annotations

import numpy as np
import pytest

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.tracks.scene_motion import Known, Motion, fit

SIZE = (480, 640)
FOCAL, OTHER_FOCAL = 640.0, 550.0
"""The one that is guessed, and another."""
CENTER = np.array([319.5, 239.5])


def camera(t: float, points: FloatArray, focal: float = FOCAL) -> tuple[FloatArray, FloatArray]:
    """Project points (N, 3) into a camera that moves and turns, t frames after the first: (N, 2) px, depths (N,)."""
    c, s = np.cos(0.004 * t), np.sin(0.004 * t)
    x = (points - np.array([0.01, 0.002, 0.004]) * t) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return focal * x[:, :2] / x[:, 2:] + CENTER, x[:, 2]


def learn(points: FloatArray, seed: int, moving: int = 0, focal: float = FOCAL) -> tuple[list[Motion], Known]:
    """Follow points through frames 0, 5 ... 20, the last ones moving by themselves, from nothing known."""
    rng = np.random.default_rng(seed)
    count = len(points)
    known = Known(np.ones(count), np.full(count, 0.5), np.full(count, 0.9))
    motions = [Motion.none(SIZE)]
    own = np.where(np.arange(count)[:, None] >= count - moving, np.array([3.0, -1.5]), 0.0)
    for t in range(0, 20, 5):
        source, target = (camera(a, points, focal)[0] + rng.normal(0, 0.1, (count, 2)) + a * own for a in (t, t + 5))
        motion, then = fit(motions[-1], source, target, known)
        _, inverse_depth = motion.move(source, then.inverse_depth)
        _, change = motion.by_inverse_depth(source, then.inverse_depth)
        known = Known(inverse_depth, then.sigma * change, then.still)
        motions.append(motion)
    return motions, known


def cloud(seed: int) -> FloatArray:
    return np.random.default_rng(seed).uniform([-2, -1.5, 2], [2, 1.5, 6], (600, 3))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_depths_are_learned(seed: int) -> None:
    points = cloud(seed)
    _, known = learn(points, seed)
    # A turn looks like an inverse depth that all have in common: they are known but for that, and for their scale.
    assert np.corrcoef(1 / camera(20, points)[1], known.inverse_depth)[0, 1] > 0.8


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_moves_by_itself_is_told_apart(seed: int) -> None:
    _, known = learn(cloud(seed), seed, moving=90)
    assert (known.still[:-90] > 0.5).mean() > 0.9
    assert (known.still[-90:] < 0.5).mean() > 0.9


@pytest.mark.parametrize("focal", [FOCAL, OTHER_FOCAL])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_hidden_points_go_on_as_the_scene_does(seed: int, focal: float) -> None:
    points = cloud(seed)
    _, known = learn(points, seed, focal=focal)
    # The left third is hidden from frame 20; the rest is followed to frame 35.
    source, _ = camera(20, points, focal)
    hidden = source[:, 0] < 210
    at, inverse_depth = source[hidden], known.inverse_depth[hidden]
    flat, middle = at, np.full(len(at), np.median(known.inverse_depth))
    rest = Known(known.inverse_depth[~hidden], known.sigma[~hidden], known.still[~hidden])
    motion = Motion.none(SIZE)
    for t in range(20, 35, 5):
        now, target = (camera(a, points, focal)[0][~hidden] for a in (t, t + 5))
        motion, then = fit(motion, now, target, rest)
        rest = Known(motion.move(now, then.inverse_depth)[1], then.sigma, then.still)
        at, inverse_depth = motion.move(at, inverse_depth)
        flat, middle = motion.move(flat, middle)
    truth = camera(35, points, focal)[0][hidden]
    error, other = (float(np.median(np.linalg.norm(a - truth, axis=1))) for a in (at, flat))
    assert error < 1.5
    assert other > 3 * error


def test_derivatives_are_those_of_the_motion() -> None:
    rng = np.random.default_rng(0)
    step = np.concatenate(([0.05, -0.03, 0.1, 0.1, -0.05, 0.07], rng.normal(0, 1, 10)))
    motion = Motion.none(SIZE).stepped(step, np.eye(16))
    points, inverse_depth = rng.uniform(50, 400, (5, 2)), rng.uniform(0.5, 2, 5)
    small = 1e-6
    by_motion = np.stack(
        [
            (motion.stepped(d, np.eye(16)).move(points, inverse_depth)[0]
             - motion.stepped(-d, np.eye(16)).move(points, inverse_depth)[0]) / (2 * small)
            for d in small * np.eye(16)
        ],
        axis=2,
    )  # fmt: skip
    np.testing.assert_allclose(motion.by_motion(points, inverse_depth), by_motion, atol=1e-5)
    (ahead, near), (behind, far) = (motion.move(points, inverse_depth + d) for d in (small, -small))
    by_depth, change = motion.by_inverse_depth(points, inverse_depth)
    np.testing.assert_allclose(by_depth, (ahead - behind) / (2 * small), atol=1e-5)
    np.testing.assert_allclose(change, (near - far) / (2 * small), atol=1e-7)
