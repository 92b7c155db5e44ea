"""Stages 1 and 2 together: a second stage 2 where the first one began far from the focal length."""

from __future__ import annotations

import numpy as np
import pytest
from stage_samples import K, observe, shift

from uni4d_fg.config.load import load_config
from uni4d_fg.geometry import se3
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.slam.stages.scene import StaticScene
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver

FRAMES, TRACKS = 16, 400
SLIDING = 0.15


def solved(factor: float, preset: str = "default", hooks: Hooks | None = None) -> StaticScene:
    """Noisy tracks, some of which slide by up to 12 px, from a focal length that is wrong by ``factor``."""
    rng, t = np.random.default_rng(3), np.arange(FRAMES)
    path = np.stack(
        [0.05 * np.sin(t / 3), 0.04 * t, 0.02 * np.sin(t / 4), 0.08 * t, 0.05 * np.sin(0.4 * t), 0.03 * t], axis=1
    )
    exact = observe(rng.uniform([-1.5, -1.0, 2.0], [3.0, 1.5, 6.0], size=(TRACKS, 3)), se3.se3_exp(path))
    noise = rng.standard_t(3.0, size=(TRACKS, FRAMES, 2)) * 0.4
    slide = rng.uniform(-1.0, 1.0, size=(TRACKS, 1, 2)) * np.linspace(0.0, 12.0, FRAMES)[None, :, None]
    noisy = shift(exact, noise + slide * (rng.random((TRACKS, 1, 1)) < SLIDING))
    noisy.depth[:] *= np.exp(rng.normal(scale=0.03, size=noisy.depth.shape)).astype(np.float32)
    wrong = K * [factor, factor, 1.0, 1.0]
    solver = StaticSceneSolver(load_config(preset), hooks=hooks)
    return solver.solve(noisy, wrong, wrong, free_intrinsics=True)


def bundle_adjustments(scene: StaticScene) -> int:
    return sum(solve.name == "bundle_adjustment" for solve in scene.solves)


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.7, 3.0])
def test_a_start_far_from_the_focal_length_ends_where_a_near_one_ends(factor: float) -> None:
    near, far = solved(1.05), solved(factor)
    assert bundle_adjustments(near) == 2
    assert bundle_adjustments(far) == 4
    # One pass alone keeps other tracks than these, from each of these starts.
    np.testing.assert_array_equal(far.landmark_track, near.landmark_track)
    assert len(far.observations) == len(near.observations)
    sigma = float(np.sqrt(near.intrinsics_covariance[0, 0]))
    assert abs(far.cameras.intrinsics[0] - near.cameras.intrinsics[0]) < 0.4 * sigma
    assert abs(far.cameras.intrinsics[0] - K[0]) < 2.0 * sigma


def test_the_energy_of_the_paper_and_a_cancelled_solve_go_once() -> None:
    assert bundle_adjustments(solved(1.7, "paper")) == 1
    began: list[str] = []
    hooks = Hooks(
        on_iteration=lambda name, iteration, energy: began.append(name),
        should_stop=lambda: began.count("bundle_adjustment") >= 2,
    )
    assert bundle_adjustments(solved(3.0, hooks=hooks)) == 1
