"""The scene behind what moves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from uni4d_fg.cues.behind_moving import depth_behind

ROWS, COLUMNS = np.mgrid[:60, :90].astype(np.float32)


@example(slope=(-0.00056, -0.00082), row=48, column=81)
@given(
    slope=st.tuples(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3)), row=st.integers(0, 60), column=st.integers(0, 90)
)
def test_a_thing_before_a_plane_is_filled_with_the_plane(slope: tuple[float, float], row: int, column: int) -> None:
    plane = 1 / (0.5 + slope[0] * ROWS + slope[1] * COLUMNS)
    moving = np.hypot(ROWS - row, COLUMNS - column) < 12
    depth = np.where(moving, 0.7, plane).astype(np.float32)
    behind = depth_behind(depth, moving)
    np.testing.assert_array_equal(behind[~moving], depth[~moving])
    # Blocks are constant, and a plane is not: by up to 0.4 % per pixel, and a thing in a corner is seen from one side.
    np.testing.assert_allclose(behind[moving], plane[moving], rtol=0.1)
    assert depth[~moving].min() <= behind.min() * (1 + 1e-6)
    assert behind.max() <= depth[~moving].max() * (1 + 1e-6)


def test_constant_depth_is_continued_exactly() -> None:
    moving = np.zeros(ROWS.shape, bool)
    moving[20:40, 30:] = True
    depth = np.where(moving, 1.0, 4.0).astype(np.float32)
    np.testing.assert_allclose(depth_behind(depth, moving), 4.0, rtol=1e-6)


def test_unknown_depth_says_nothing() -> None:
    depth = np.full(ROWS.shape, 3.0, np.float32)
    depth[:, 40:] = np.nan
    moving = (ROWS > 20) & (ROWS < 30)
    behind = depth_behind(depth, moving)
    np.testing.assert_allclose(behind[moving], 3.0, rtol=1e-6)
    assert np.isnan(behind[~moving & (COLUMNS >= 40)]).all()


@pytest.mark.parametrize("moving", [np.zeros(ROWS.shape, bool), np.ones(ROWS.shape, bool)])
def test_without_a_mark_or_with_nothing_else_depth_stays(moving: np.ndarray) -> None:
    depth = (1 + ROWS / 60).astype(np.float32)
    np.testing.assert_array_equal(depth_behind(depth, moving), depth)
