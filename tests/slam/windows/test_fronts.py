"""Elimination of windows along their chain against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.errors import SolverError
from uni4d_fg.slam.windows.fronts import Entries, FrontChain, sandwich_blocks, stepped_chain
from uni4d_fg.slam.windows.plan import Window, plan_windows

PER_FRAME, SHARED, OWN = 3, 2, 2
"""Columns of a frame, of the border that windows tie, and of the border that only further entries tie."""


def definite(rng: np.random.Generator, windows: list[Window]) -> list[np.ndarray]:
    sizes = [PER_FRAME * len(window) + SHARED for window in windows]
    roots = [rng.normal(size=(size, size)) for size in sizes]
    return [root.T @ root + np.eye(len(root)) for root in roots]


def ties(rng: np.random.Generator, num_frames: int, count: int) -> list[Entries]:
    """Entries between frames anywhere, and between each of these and what is the border's own."""
    size = PER_FRAME * num_frames + SHARED + OWN
    entries = []
    for _ in range(count):
        first, second = rng.integers(0, num_frames, 2)
        own = np.arange(size - OWN, size)
        columns = np.unique(np.concatenate([PER_FRAME * f + np.arange(PER_FRAME) for f in (first, second)] + [own]))
        root = rng.normal(size=(len(columns), len(columns)))
        block = root.T @ root
        entries.append((np.repeat(columns, len(columns)), np.tile(columns, len(columns)), block.reshape(-1)))
    return entries


def dense(windows: list[Window], matrices: list[np.ndarray], entries: list[Entries], free: np.ndarray) -> np.ndarray:
    """The sum on the free columns."""
    whole = np.zeros((len(free), len(free)))
    border = PER_FRAME * windows[-1].stop
    for window, matrix in zip(windows, matrices, strict=True):
        columns = np.arange(PER_FRAME * window.start, PER_FRAME * window.stop)
        columns = np.concatenate([columns, np.arange(border, border + SHARED)])
        whole[np.ix_(columns, columns)] += matrix
    for rows, columns, values in entries:
        np.add.at(whole, (rows, columns), values)
    return whole[np.ix_(free, free)]


def blocks(inverse: np.ndarray, free: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    whole = np.zeros((len(free), len(free)))
    whole[np.ix_(free, free)] = inverse
    inside = PER_FRAME * count
    frames = whole[:inside, :inside].reshape(count, PER_FRAME, count, PER_FRAME)
    return frames[np.arange(count), :, np.arange(count)], whole[inside:, inside:]


@settings(max_examples=80, deadline=None)
@given(
    st.integers(2, 4), st.integers(0, 5), st.integers(2, 50), st.integers(0, 2), st.integers(0, 6),
    st.integers(0, 10**6),
)  # fmt: skip
def test_solutions_and_blocks_are_those_of_the_dense_matrix(
    overlap: int, more: int, num_frames: int, free_border: int, count: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    windows = plan_windows(num_frames, 3 * overlap + more, overlap)
    inside = PER_FRAME * num_frames
    free = np.ones(inside + SHARED + OWN, dtype=bool)
    free[:2] = False
    free[inside + free_border : inside + SHARED] = False
    free[inside + SHARED :] = count > 0
    outer, inner, entries = definite(rng, windows), definite(rng, windows), ties(rng, num_frames, count)
    inverse = np.linalg.inv(dense(windows, outer, entries, free))

    chain = FrontChain(windows, outer, free, PER_FRAME, SHARED, entries)
    sides = rng.normal(size=(3, len(free)))
    expected = np.zeros_like(sides)
    expected[:, free] = sides[:, free] @ inverse
    np.testing.assert_allclose(chain.solve(sides), expected, atol=1e-9)
    plain = chain.inverse_blocks()
    sandwiched = inverse @ dense(windows, inner, entries, free) @ inverse
    stepped = stepped_chain(windows, outer, inner, free, PER_FRAME, SHARED, entries)
    np.testing.assert_allclose(stepped.real().solve(sides), expected, atol=1e-9)
    by_step = sandwich_blocks(stepped)
    for found, wanted in ((plain, inverse), (by_step[0], inverse), (by_step[1], sandwiched)):
        for part, true in zip(found, blocks(wanted, free, num_frames), strict=True):
            np.testing.assert_allclose(part, true, atol=1e-9 * np.abs(true).max(initial=1.0))


def test_columns_that_nothing_determines_are_an_error() -> None:
    windows = plan_windows(12, 6, 2)
    matrices = definite(np.random.default_rng(0), windows)
    for window, matrix in zip(windows, matrices, strict=True):
        if window.start <= 5 < window.stop:
            row = PER_FRAME * (5 - window.start)
            matrix[row], matrix[:, row] = 0.0, 0.0
    free = np.ones(PER_FRAME * 12 + SHARED, dtype=bool)
    with pytest.raises(SolverError, match="do not determine every camera"):
        FrontChain(windows, matrices, free, PER_FRAME, SHARED)
