"""How far a view moves on."""

from __future__ import annotations

import numpy as np
import pytest
from cues.start_scenes import SIZE, K, camera_path, observed, sideways, tracked

from uni4d_fg.cues.structure.sweep import view_sweep

FRAMES = 30


@pytest.mark.parametrize("turn", [0.2, 0.8, 1.6])
def test_a_turn_moves_the_view_by_its_angle(turn: float) -> None:
    scene = tracked(camera_path(FRAMES, (0.0, 0.0, 0.0), (0.0, turn, 0.0)), 0, points=3000)
    # Pixels are tangents: in the middle of the picture an angle is f px, at its sides more.
    assert K[0] * turn / SIZE[1] < view_sweep(scene.observations, FRAMES, SIZE) < 1.2 * K[0] * turn / SIZE[1]


def test_the_way_back_does_not_count_and_the_height_does() -> None:
    up_and_down = 0.5 * SIZE[0] * np.sin(np.linspace(0.0, 3 * np.pi, FRAMES))
    start = np.random.default_rng(0).uniform((0, 0), SIZE[::-1], (50, 2))
    rows: list[tuple[np.ndarray, ...]] = [
        (np.arange(50), np.full(50, frame), start + np.array([0.01 * frame, shift]))
        for frame, shift in enumerate(up_and_down)
    ]
    assert view_sweep(observed(rows), FRAMES, SIZE) == pytest.approx(1.0, abs=0.02)


def test_a_walk_is_no_sweep_and_nothing_seen_twice_moves_nothing() -> None:
    assert view_sweep(tracked(sideways(FRAMES), 0).observations, FRAMES, SIZE) < 0.5
    once: list[tuple[np.ndarray, ...]] = [
        (np.array([frame]), np.array([frame]), np.full((1, 2), 10.0)) for frame in range(3)
    ]
    assert view_sweep(observed(once), 3, SIZE) == 0.0
