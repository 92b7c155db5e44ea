"""Joining windows ends where no further step would move a camera."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uni4d_fg.geometry import se3
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.information import FRAME, SHARED, WindowInformation
from uni4d_fg.slam.windows.join import join
from uni4d_fg.slam.windows.plan import Window

WINDOWS = [Window(0, 5), Window(3, 8), Window(6, 11)]
COUNT = WINDOWS[-1].stop


def parts_and_start(rng: np.random.Generator, noise: float) -> tuple[list[WindowInformation], Cameras]:
    """Windows that disagree by some noise, and a start beside all of them."""
    poses = np.stack([se3.se3_exp(np.array([0.1, 0.2, -0.1, 0.5, 0.2, 0.1]) * t) for t in range(COUNT)])
    truth = Cameras(poses, np.array([100.0, 100.0, 50.0, 50.0]), np.zeros(COUNT))
    parts = []
    for window in WINDOWS:
        size = FRAME * len(window) + SHARED
        root = rng.normal(size=(2 * size, size))
        root[:, :6] = 0.0
        root[:, -SHARED:] = 0.0
        point = truth.part(window.start, window.stop)
        moved = rng.normal(scale=noise, size=(len(window), 6)) * (np.arange(len(window)) > 0)[:, None]
        here = Cameras(
            se3.retract(point.world_T_cam, moved), point.intrinsics, rng.normal(scale=noise, size=len(window))
        )
        parts.append(WindowInformation(window, here, root.T @ root, root.T @ rng.normal(scale=noise, size=2 * size)))
    beside = se3.retract(poses, rng.normal(scale=noise, size=(COUNT, 6)) * (np.arange(COUNT) > 0)[:, None])
    return parts, Cameras(beside, truth.intrinsics, np.zeros(COUNT))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), noise=st.sampled_from([1e-6, 1e-3, 0.02]))
@example(seed=207856, noise=0.02)  # steps of 4e-3, 4e-5, 2e-7 and 1e-8: the last two shrink by different factors
def test_another_join_from_where_one_ended_moves_nothing(seed: int, noise: float) -> None:
    parts, start = parts_and_start(np.random.default_rng(seed), noise)
    once = join(parts, start, np.zeros((4, 4))).cameras
    again = join(parts, once, np.zeros((4, 4))).cameras
    assert np.abs(se3.se3_log(se3.inverse(once.world_T_cam) @ again.world_T_cam)).max() < 1e-8
    assert np.abs(once.log_scale - again.log_scale).max() < 1e-8


def test_the_energy_is_lowest_there() -> None:
    rng = np.random.default_rng(5)
    parts, start = parts_and_start(rng, 0.02)
    found = join(parts, start, np.zeros((4, 4))).cameras

    def energy(cameras: Cameras) -> float:
        total = 0.0
        for part in parts:
            d, _ = part.difference(cameras)
            total += 0.5 * d @ part.hessian @ d + part.gradient @ d
        return total

    for _ in range(20):
        step = rng.normal(scale=1e-4, size=(COUNT, 6)) * (np.arange(COUNT) > 0)[:, None]
        moved = Cameras(se3.retract(found.world_T_cam, step), found.intrinsics, found.log_scale)
        assert energy(moved) > energy(found)
