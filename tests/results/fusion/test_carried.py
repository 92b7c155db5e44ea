"""Depth of other frames, carried into one."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.fusion.carried import carried_depth

K = np.array([100.0, 100.0, 39.5, 29.5])
SHAPE = (60, 80)


def at(x: float, z: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, 0.0, z
    return pose


def test_a_wall_is_carried_and_what_nobody_sees_is_filled() -> None:
    wall = np.full(SHAPE, 2.0, np.float32)
    found = carried_depth(SHAPE, at(0.0), [(wall, at(0.1), K), (wall - np.float32(0.2), at(-0.1, 0.2), K)], K)
    np.testing.assert_allclose(found, 2.0, atol=0.01)


def test_the_nearer_surface_hides_the_farther() -> None:
    depth = np.full(SHAPE, 3.0, np.float32)
    depth[20:40, 30:50] = 1.0
    found = carried_depth(SHAPE, at(0.0), [(depth, at(0.05), K)], K)
    # The board moves by 5 px, the wall by 1.7 px.
    np.testing.assert_allclose(found[25:35, 37:53], 1.0, atol=1e-4)
    np.testing.assert_allclose(found[:15], 3.0, atol=1e-3)


def test_nothing_gives_nothing() -> None:
    assert np.isnan(carried_depth(SHAPE, at(0.0), [], K)).all()
