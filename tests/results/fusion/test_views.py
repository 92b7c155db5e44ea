"""Which frames a frame is matched with."""

import numpy as np
import pytest

from uni4d_fg.config.multiview import MultiviewConfig
from uni4d_fg.results.fusion.multiview.views import choose_views

CONFIG = MultiviewConfig()
SIZE = (240, 320)
FRAME, FRAMES = 100, 201


def chosen(step: float) -> list[int]:
    """Views of a camera that moves to the right by ``step`` per frame, before points 4 to 6 m away."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = step * (np.arange(FRAMES) - FRAME)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 6), (400, 3))
    intrinsics = np.tile((300.0, 300.0, 159.5, 119.5), (FRAMES, 1))
    return choose_views(FRAME, poses, points, intrinsics, SIZE, CONFIG)


def angle(step: float, view: int) -> float:
    """Degrees, of the rays to a point 5 m away."""
    return float(np.degrees(np.arctan(step * abs(view - FRAME) / 5.0)))


@pytest.mark.parametrize("step", [0.02, 0.05, 0.2])
def test_views_are_near_the_wanted_angle(step: float) -> None:
    views = chosen(step)
    assert sorted(view > FRAME for view in views) == [False, False, True, True]
    best = min(CONFIG.reach, round(5.0 * np.tan(np.radians(CONFIG.wanted_angle_deg)) / step))
    assert all(abs(abs(view - FRAME) - best) <= 2 for view in views)


@pytest.mark.parametrize(("step", "views", "least"), [(0.0008, 4, 44), (0.0015, 4, 24), (0.0021, 4, 16)])
def test_a_slow_camera_is_followed_farther(step: float, views: int, least: int) -> None:
    """Its frames nearby show nothing from another side."""
    found = chosen(step)
    assert len(found) == views
    assert {view > FRAME for view in found} == {False, True}
    assert all(angle(step, view) > 0.95 * CONFIG.min_angle_deg for view in found)
    assert least <= min(abs(view - FRAME) for view in found)
    assert max(abs(view - FRAME) for view in found) <= 4 * CONFIG.reach


def test_one_that_hardly_moves_has_no_views() -> None:
    assert chosen(0.0004) == []
