"""Elimination of windows along their chain against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.errors import SolverError
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.fronts import FrontChain, sandwich_blocks
from uni4d_fg.slam.windows.information import FRAME, WindowInformation
from uni4d_fg.slam.windows.plan import Window, plan_windows
from uni4d_fg.slam.windows.sparse_sum import SparseSum

PER_FRAME, BORDER = 3, 2


def definite(rng: np.random.Generator, windows: list[Window]) -> list[np.ndarray]:
    sizes = [PER_FRAME * len(window) + BORDER for window in windows]
    roots = [rng.normal(size=(size, size)) for size in sizes]
    return [root.T @ root + np.eye(len(root)) for root in roots]


def dense(windows: list[Window], matrices: list[np.ndarray], free: np.ndarray) -> np.ndarray:
    """The sum on the free columns."""
    whole = np.zeros((len(free), len(free)))
    for window, matrix in zip(windows, matrices, strict=True):
        columns = np.arange(PER_FRAME * window.start, PER_FRAME * window.stop)
        columns = np.concatenate([columns, np.arange(len(free) - BORDER, len(free))])
        whole[np.ix_(columns, columns)] += matrix
    return whole[np.ix_(free, free)]


def blocks(inverse: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    whole = np.zeros((len(free), len(free)))
    whole[np.ix_(free, free)] = inverse
    count = (len(free) - BORDER) // PER_FRAME
    frames = whole[:-BORDER, :-BORDER].reshape(count, PER_FRAME, count, PER_FRAME)
    return frames[np.arange(count), :, np.arange(count)], whole[-BORDER:, -BORDER:]


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 4), st.integers(0, 5), st.integers(2, 50), st.integers(0, 2), st.integers(0, 10**6))
def test_solutions_and_blocks_are_those_of_the_dense_matrix(
    overlap: int, more: int, num_frames: int, free_border: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    windows = plan_windows(num_frames, 3 * overlap + more, overlap)
    free = np.ones(PER_FRAME * num_frames + BORDER, dtype=bool)
    free[:2] = False
    free[len(free) - BORDER + free_border :] = False
    outer, inner = definite(rng, windows), definite(rng, windows)
    whole = dense(windows, outer, free)
    inverse = np.linalg.inv(whole)

    chain = FrontChain(windows, outer, free, PER_FRAME)
    sides = rng.normal(size=(3, len(free)))
    expected = np.zeros_like(sides)
    expected[:, free] = sides[:, free] @ inverse
    np.testing.assert_allclose(chain.solve(sides), expected, atol=1e-10)
    plain = chain.inverse_blocks()
    sandwiched = inverse @ dense(windows, inner, free) @ inverse
    by_step = sandwich_blocks(windows, outer, inner, free, PER_FRAME)
    for found, wanted in ((plain, inverse), (by_step[0], inverse), (by_step[1], sandwiched)):
        for part, true in zip(found, blocks(wanted, free), strict=True):
            np.testing.assert_allclose(part, true, atol=1e-11 * np.abs(true).max(initial=1.0))


def test_columns_that_nothing_determines_are_an_error() -> None:
    windows = plan_windows(12, 6, 2)
    matrices = definite(np.random.default_rng(0), windows)
    for window, matrix in zip(windows, matrices, strict=True):
        if window.start <= 5 < window.stop:
            row = PER_FRAME * (5 - window.start)
            matrix[row], matrix[:, row] = 0.0, 0.0
    free = np.ones(PER_FRAME * 12 + BORDER, dtype=bool)
    with pytest.raises(SolverError, match="do not determine every camera"):
        FrontChain(windows, matrices, free, PER_FRAME)


def test_the_sparse_sum_solves_alike() -> None:
    rng, windows = np.random.default_rng(1), plan_windows(20, 8, 2)
    cameras = Cameras(np.tile(np.eye(4), (20, 1, 1)), np.ones(4), np.zeros(20))
    parts, matrices = [], []
    for window in windows:
        root = rng.normal(size=(FRAME * len(window) + 4,) * 2)
        matrices.append(root.T @ root)
        here = cameras.part(window.start, window.stop)
        parts.append(WindowInformation(window, here, matrices[-1], root[0], matrices[-1], None))
    free = np.ones(FRAME * 20 + 4, dtype=bool)
    free[:6] = False
    sides = rng.normal(size=(5, len(free)))
    by_fronts = FrontChain(windows, matrices, free, FRAME).solve(sides)
    np.testing.assert_allclose(by_fronts, SparseSum(parts, matrices, [], free).solve(sides), rtol=1e-7, atol=1e-9)
    assert not by_fronts[:, :6].any()
