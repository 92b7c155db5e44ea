"""Rows by group, sums by row and spread indices, against loops."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uni4d_fg.arrays import evenly_spread, rows_by_group, sum_rows


@given(st.lists(st.integers(0, 6), max_size=40), st.integers(7, 9))
def test_rows_of_each_group_are_ascending_and_complete(groups: list[int], count: int) -> None:
    group = np.array(groups, dtype=np.int64)
    found = rows_by_group(group, count)
    assert len(found) == count
    for number, rows in enumerate(found):
        np.testing.assert_array_equal(rows, np.flatnonzero(group == number))


@given(st.lists(st.tuples(st.integers(0, 4), st.floats(-10, 10), st.floats(-10, 10)), max_size=30))
def test_sums_of_rows(entries: list[tuple[int, float, float]]) -> None:
    row = np.array([entry[0] for entry in entries], dtype=np.int64)
    values = np.array([entry[1:] for entry in entries], dtype=np.float64).reshape(-1, 2)
    expected = np.array([values[row == number].sum(axis=0) for number in range(5)])
    np.testing.assert_allclose(sum_rows(values, row, 5), expected, atol=1e-12)


@given(st.integers(1, 500), st.integers(1, 500))
def test_spread_indices_hold_both_ends(count: int, limit: int) -> None:
    chosen = evenly_spread(count, limit)
    assert len(chosen) == len(np.unique(chosen)) == min(count, limit)
    assert chosen[0] == 0
    assert limit == 1 or chosen[-1] == count - 1
