"""Edges of depth that is not sure are those of the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.guided_median import guided_median, guided_median_numpy

SHAPE = (40, 60)
EVERYWHERE = np.ones(SHAPE, bool)


def two_surfaces(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Log depth of a thing before a wall, and an image twice as large in which they have colors of their own."""
    near = np.zeros(SHAPE, bool)
    near[10:30, 20:40] = True
    large = np.kron(near, np.ones((2, 2), bool))
    image = np.where(large[..., None], [180, 60, 60], [60, 90, 170]) + rng.normal(0, 4, (*large.shape, 3))
    return np.where(near, np.log(2.0), np.log(3.0)).astype(np.float32), np.clip(image, 0, 255).astype(np.uint8)


def test_a_mixture_beside_an_edge_becomes_the_surface_that_it_looks_like(rng: np.random.Generator) -> None:
    truth, image = two_surfaces(rng)
    depth, sure = truth.copy(), np.full(SHAPE, 0.95, np.float32)
    band = np.zeros(SHAPE, bool)
    band[7:33, 17:43] = True
    band[13:27, 23:37] = False
    depth[band], sure[band] = np.log(2.4), 0.05
    found = guided_median(depth, sure, EVERYWHERE, image)
    np.testing.assert_array_equal(found[~band], depth[~band])
    wrong = np.abs(found - truth)[band] > 0.01
    assert wrong.mean() < 0.02
    left = band & (np.arange(SHAPE[1]) < 30)
    np.testing.assert_array_equal(guided_median(depth, sure, ~left, image)[left], depth[left])


def test_nothing_is_changed_where_depth_is_sure_and_nothing_made_where_it_is_missing(rng: np.random.Generator) -> None:
    truth, image = two_surfaces(rng)
    np.testing.assert_array_equal(guided_median(truth, np.full(SHAPE, 0.6, np.float32), EVERYWHERE, image), truth)
    missing = truth.copy()
    missing[5:20, 5:30] = np.nan
    found = guided_median(missing, np.zeros(SHAPE, np.float32), EVERYWHERE, image)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(missing))


def test_what_is_unsure_continues_the_planes_around_it() -> None:
    """A floor that goes far and a wall at its end, in two colors: neither is carried into the other, or nearer."""
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    floor = row > 14
    inverse = np.where(floor, 0.2 + 0.006 * (row - 14), 0.1 + 0.001 * column)
    image = np.where(floor[..., None], [140, 110, 60], [70, 90, 150]).astype(np.uint8)
    truth = -np.log(inverse).astype(np.float32)
    hole = (np.abs(row - 18) < 8) & (np.abs(column - 30) < 7)
    depth, sure = truth.copy(), np.full(SHAPE, 0.95, np.float32)
    depth[hole], sure[hole] = np.log(4.0), 0.02
    found = guided_median(depth, sure, EVERYWHERE, image)
    off = np.abs(found - truth)[hole]
    assert off.mean() < 0.01
    assert (off > 0.05).mean() < 0.02


@given(seed=st.integers(0, 2**16), side=st.integers(1, 12))
@settings(max_examples=25, deadline=None)
def test_depth_stays_among_what_is_there(seed: int, side: int) -> None:
    """Whatever the size and the holes: every depth is one of those around, as no mean is taken, where none slopes."""
    rng = np.random.default_rng(seed)
    depth = rng.choice(np.linspace(0.0, 2.0, 11), (side, 2 * side)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = np.nan
    image = rng.integers(0, 256, (3 * side, 6 * side, 3), dtype=np.uint8)
    found = guided_median(depth, rng.random(depth.shape).astype(np.float32), np.ones(depth.shape, bool), image)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(depth))
    known = np.isfinite(depth)
    if known.any():
        apart = np.abs(found[known][:, None] - np.unique(depth[known])[None]).min(axis=1)
        assert apart.max() < 1e-5


@pytest.mark.parametrize(
    ("height", "width", "reach", "step", "spatial"),
    [(40, 60, 12, 4, 6.0), (7, 50, 12, 4, 6.0), (1, 1, 12, 4, 6.0), (20, 430, 15, 5, 8.0), (40, 60, 18, 6, 8.4)],
)
def test_cpp_and_numpy_agree(
    rng: np.random.Generator, height: int, width: int, reach: int, step: int, spatial: float
) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    values = rng.normal(1.0, 0.5, (height, width)).astype(np.float32)
    weights = rng.uniform(0.001, 1.0, (height, width)).astype(np.float32)
    weights[:, 10:20] = 0.0
    values[:, 12:18] = np.nan
    colors = rng.normal(0, 0.4, (height, width, 3)).astype(np.float32)
    slopes = rng.normal(0, 0.03, (height, width, 2)).astype(np.float32)
    chosen = ((rng.random((height, width)) < 0.8) & (weights > 0)) | (weights.size == 1)
    slow = guided_median_numpy(values, weights, slopes, colors, chosen, reach, step, spatial)
    fast = core.guided_median(
        values, weights, slopes, colors, chosen.astype(np.uint8), reach=reach, step=step, spatial=spatial, steepest=0.3
    )
    np.testing.assert_array_equal(fast[~chosen], values[~chosen])
    # Where half of the weight is met to the last bits, the next value may be taken.
    assert np.isclose(fast, slow, rtol=1e-5, atol=1e-6)[chosen].mean() > 0.999
    assert (fast != values)[chosen].mean() > (0.4 if height > 1 else -1.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"values": np.ones((3, 4))}, "values: expected float32"),
        ({"weights": np.ones((3, 5), np.float32)}, "weights: expected"),
        ({"slopes": np.ones((3, 4), np.float32)}, "slopes: expected float32"),
        ({"colors": np.ones((3, 4), np.float32)}, "colors: expected float32"),
        ({"chosen": np.ones((3, 4), bool)}, "chosen: expected uint8"),
        ({"step": 0}, "reach, step"),
        ({"spatial": 0.0}, "spatial"),
        ({"steepest": 1.0}, "steepest"),
    ],
)
def test_bad_input_is_named(wrong: dict[str, object], message: str) -> None:
    core, reason = find_extension()
    if core is None:
        pytest.skip(reason)
    given_all = {
        "values": np.ones((3, 4), np.float32), "weights": np.ones((3, 4), np.float32),
        "slopes": np.zeros((3, 4, 2), np.float32), "colors": np.ones((3, 4, 3), np.float32),
        "chosen": np.ones((3, 4), np.uint8), "reach": 4, "step": 2, "spatial": 3.0, "steepest": 0.3,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        core.guided_median(**(given_all | wrong))
