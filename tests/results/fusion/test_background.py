"""What other frames show behind a mask: color and depth of a textured wall from a camera that moves along it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from uni4d_fg.results.fusion.background import View, background

HEIGHT, WIDTH = 60, 80
INTRINSICS = np.array([70.0, 70.0, 39.5, 29.5])
TILT = 0.004
"""Change of the wall's inverse depth per pixel of a view from the origin, 1/m."""


@pytest.fixture
def texture(rng: np.random.Generator) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (200, 300, 3)), (0, 0), 2.0)
    return np.clip(128 + 5 * (noise - noise.mean()), 0, 255).astype(np.float32)


def view(texture: np.ndarray, shift: float, hidden: slice | None = None) -> View:
    """The wall z (1/2 + TILT fx x / z) = 1 from a camera at (shift, 0, 0); what is hidden is red and near."""
    fx, fy, cx, cy = INTRINSICS
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    slope = TILT * fx
    # 1 = z / 2 + slope X with X = z (x - cx) / fx + shift
    inverse = (0.5 + slope * (x - cx) / fx) / (1.0 - slope * shift)
    wall_x, wall_y = (x - cx) / fx / inverse + shift, (y - cy) / fy / inverse
    u, v = (150 + 70 * wall_x).astype(np.float32), (100 + 70 * wall_y).astype(np.float32)
    color = cv2.remap(texture, u, v, cv2.INTER_LINEAR)
    static = np.ones((HEIGHT, WIDTH), bool)
    if hidden is not None:
        color[20:40, hidden], static[18:42, max(hidden.start - 2, 0) : hidden.stop + 2] = (255, 0, 0), False
        inverse[20:40, hidden] = 1.0
    pose = np.eye(4)
    pose[0, 3] = shift
    return View((color / 255).astype(np.float32), inverse.astype(np.float32), static, pose, INTRINSICS)


def test_color_and_depth_are_those_of_the_wall(texture: np.ndarray) -> None:
    here, there = view(texture, 0.0, slice(30, 46)), view(texture, 0.0)
    others = [view(texture, 0.1, slice(48, 64)), view(texture, -0.15, slice(8, 24))]
    where = ~here.static
    found = background(here, others, where)
    assert found.seen[where].mean() > 0.95
    assert not found.seen[~where].all()
    at = found.seen & where
    np.testing.assert_allclose(found.inverse[at], there.inverse[at], rtol=0.004)  # of a slope, seen from beside
    assert np.abs(found.color - there.color)[at].mean() < 0.03
    assert np.abs(found.color - here.color)[20:40, 30:46].mean() > 0.2
    assert found.variance[at].mean() < 1e-3


def test_what_is_masked_in_the_others_too_is_not_seen(texture: np.ndarray) -> None:
    here = view(texture, 0.0, slice(30, 46))
    same = [view(texture, shift, slice(30, 46)) for shift in (0.0, 0.01)]
    assert not background(here, same, ~here.static).seen[20:40, 30:46].any()


def test_another_surface_does_not_count(texture: np.ndarray) -> None:
    here, others = view(texture, 0.0, slice(30, 46)), [view(texture, 0.05), view(texture, -0.05)]
    near = [other._replace(inverse=1.5 * other.inverse) for other in others]
    assert background(here, others, ~here.static).seen.any()
    assert not background(here, near, ~here.static).seen.any()


def test_one_frame_alone_is_not_believed(texture: np.ndarray) -> None:
    here = view(texture, 0.0, slice(30, 46))
    assert not background(here, [view(texture, 0.05)], ~here.static).seen.any()


def test_nothing_is_looked_up_where_nothing_is_masked_or_known(texture: np.ndarray) -> None:
    here = view(texture, 0.0)
    both = [view(texture, 0.1), view(texture, -0.1)]
    assert not background(here, both, ~here.static).seen.any()
    blind = view(texture, 0.0, slice(30, 46))._replace(static=np.zeros((HEIGHT, WIDTH), bool))
    assert not background(blind, both, ~blind.static).seen.any()
    missing = [other._replace(inverse=np.full((HEIGHT, WIDTH), np.nan, np.float32)) for other in both]
    some = view(texture, 0.0, slice(30, 46))
    assert not background(some, missing, ~some.static).seen.any()
