"""What is unsure continues what is sure around it; edges and what is sure stay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.results.fusion import planar_smoothing
from uni4d_fg.results.fusion.planar_smoothing import smoothed_where_unsure

HEIGHT, WIDTH = 120, 160


def plane(across: float = 0.5, down: float = 0.3) -> np.ndarray:
    """Inverse depth of a plane."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.asarray(1.0 + across * u / WIDTH + down * v / HEIGHT, np.float32)


def spotted(inverse: np.ndarray, share: float, seed: int = 0) -> np.ndarray:
    """Log depth with spots of some ten pixels that are wrong by this part."""
    small = np.random.default_rng(seed).standard_normal((HEIGHT // 10, WIDTH // 10))
    spots = np.kron(small, np.ones((10, 10))).astype(np.float32)
    return np.asarray(-np.log(inverse * (1 + np.float32(share) * spots)), np.float32)


def gray(value: float = 0.5) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), value, np.float32)


def error(log_depth: np.ndarray, inverse: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute error of log depth."""
    return float(np.abs(log_depth + np.log(inverse))[where].mean())


@given(across=st.floats(-0.6, 0.6), down=st.floats(-0.6, 0.6), probability=st.floats(0, 1))
def test_a_plane_stays_what_it_is(across: float, down: float, probability: float) -> None:
    inverse = plane(across, down) + np.float32(0.5)
    sure = np.full((HEIGHT, WIDTH), probability, np.float32)
    out = smoothed_where_unsure(-np.log(inverse), sure, gray())
    # The outermost half node takes the value of its center.
    assert np.abs(out + np.log(inverse))[2:-2, 2:-2].max() < 2e-4


def test_spots_between_sure_parts_of_a_plane_are_smoothed() -> None:
    inverse = plane()
    hole = np.zeros((HEIGHT, WIDTH), bool)
    hole[30:90, 40:120] = True
    found = np.where(hole, spotted(inverse, 0.03), -np.log(inverse)).astype(np.float32)
    out = smoothed_where_unsure(found, np.where(hole, 0.1, 0.95).astype(np.float32), gray())
    assert error(found, inverse, hole) > 0.02
    assert error(out, inverse, hole) < 0.004
    np.testing.assert_array_equal(out[~hole], found[~hole])


def test_sure_depth_is_kept_to_the_digit() -> None:
    found = spotted(plane(), 0.03)
    sure = np.full((HEIGHT, WIDTH), 0.71, np.float32)
    np.testing.assert_array_equal(smoothed_where_unsure(found, sure, gray()), found)


def test_an_edge_of_depth_and_image_stays_where_it_is() -> None:
    """Two walls, the left one nearer; nothing is sure within 12 pixels of the edge between them."""
    u = np.arange(WIDTH)[None, :].repeat(HEIGHT, axis=0)
    inverse = np.where(u < 80, plane(), plane() / 2).astype(np.float32)
    beside = np.abs(u - 79.5) < 12
    found = np.where(beside, spotted(inverse, 0.02), -np.log(inverse)).astype(np.float32)
    color = np.where((u < 80)[..., None], gray(0.3), gray(0.7)).astype(np.float32)
    out = smoothed_where_unsure(found, np.where(beside, 0.1, 0.95).astype(np.float32), color)
    near, far = beside & (u < 76), beside & (u > 84)
    assert error(out, inverse, near) < 0.2 * error(found, inverse, near)
    assert error(out, inverse, far) < 0.2 * error(found, inverse, far)
    np.testing.assert_array_equal(out[:, 79:81], found[:, 79:81])


def test_what_is_far_is_not_carried_away_by_what_is_near() -> None:
    """A tenth of the inverse depth beside a near wall, unsure: its depth stays to 2 %, as absolute terms would not."""
    u = np.arange(WIDTH)[None, :].repeat(HEIGHT, axis=0)
    inverse = np.where(u < 80, 1.0, 0.1).astype(np.float32)
    sure = np.where(u < 80, 0.95, 0.1).astype(np.float32)
    out = smoothed_where_unsure(-np.log(inverse), sure, gray())
    assert np.abs(out + np.log(inverse))[:, 84:].max() < 0.02


def test_what_is_missing_stays_missing_and_says_nothing() -> None:
    inverse = plane()
    hole = np.zeros((HEIGHT, WIDTH), bool)
    hole[30:90, 40:120] = True
    missing = np.zeros_like(hole)
    missing[50:70, 60:100] = True
    found = np.where(hole, spotted(inverse, 0.03), -np.log(inverse)).astype(np.float32)
    found[missing] = np.nan
    out = smoothed_where_unsure(found, np.where(hole, 0.1, 0.95).astype(np.float32), gray())
    np.testing.assert_array_equal(np.isnan(out), missing)
    assert error(out, inverse, hole & ~missing) < 0.004
    nothing = np.full_like(found, np.nan)
    np.testing.assert_array_equal(smoothed_where_unsure(nothing, np.zeros_like(found), gray()), nothing)


@pytest.mark.parametrize(("height", "width"), [(1, 4), (2, 3), (3, 3), (5, 7)])
def test_the_bands_are_the_normal_equations(height: int, width: int) -> None:
    """Against a dense matrix that is summed from outer products of the differences."""
    rng = np.random.default_rng(height)
    down, along = rng.random((max(height - 2, 0), width)), rng.random((height, max(width - 2, 0)))
    mixed = rng.random((height - 1, width - 1))
    held, right = rng.random((height, width)) + 0.1, rng.random((height, width))
    normal = np.diag(held.ravel())
    number = np.arange(height * width).reshape(height, width)
    for nodes, factors, weights in (
        ((number[:-2], number[1:-1], number[2:]), (1, -2, 1), down),
        ((number[:, :-2], number[:, 1:-1], number[:, 2:]), (1, -2, 1), along),
        ((number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]), (1, -1, -1, 1), mixed),
    ):
        for at, weight in zip(np.stack(nodes, axis=-1).reshape(-1, len(factors)), weights.ravel(), strict=True):
            normal[np.ix_(at, at)] += weight * np.outer(factors, factors)
    expected = np.linalg.solve(normal, right.ravel()).reshape(height, width)
    np.testing.assert_allclose(planar_smoothing._solved(held, right, down, along, mixed), expected, atol=1e-12)


def test_it_is_a_minimum() -> None:
    """At convergence no change of single nodes lowers the energy of the module's formula."""
    rng = np.random.default_rng(3)
    inverse = 1 + 0.1 * rng.standard_normal((9, 12))
    weight, color = rng.random((9, 12)) + 0.01, rng.random((9, 12, 3)) * 0.05
    strength, bent, wrong = planar_smoothing._STRENGTH, planar_smoothing._BENT, planar_smoothing._WRONG
    links = planar_smoothing._links(np.log(inverse), color)
    middles = planar_smoothing._middles(inverse)

    def energy(x: np.ndarray) -> float:
        departs = wrong**2 * np.hypot(1, (x - inverse) / inverse / wrong)
        total = float((weight * departs).sum())
        for link, second, at in zip(links, planar_smoothing._second_differences(x), middles, strict=True):
            total += float((strength * link * np.hypot(second / at, bent)).sum())
        return total

    steps = planar_smoothing._STEPS
    try:
        planar_smoothing._STEPS = 200
        x = planar_smoothing._minimized(inverse, weight, color)
    finally:
        planar_smoothing._STEPS = steps
    least = energy(x)
    assert least < energy(inverse)
    for _ in range(50):
        assert energy(x + 1e-3 * rng.standard_normal(x.shape)) > least
