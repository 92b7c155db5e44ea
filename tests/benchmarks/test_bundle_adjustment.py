"""The benchmark of bundle adjustment: this package's solvers take its problem and end at the same cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("uni4d_fg_cpp")


def test_both_solvers_end_at_the_same_cost(load_benchmark: Callable[[str], Any]) -> None:
    benchmark = load_benchmark("bundle_adjustment")
    problem, state = benchmark.make_problem(3500)
    start = sum(problem.energies(state).values())
    cpp, python = (benchmark.solve_ours(problem, state, threads=2, cpp=cpp) for cpp in (True, False))
    assert cpp["cost"] == pytest.approx(python["cost"], rel=1e-6)
    # Two residuals of unit variance per observation, of which three in a hundred are gross errors; 0.5 r^2 each.
    assert cpp["cost"] < 0.1 * start
    assert cpp["cost"] < 2.5 * len(problem.batches[0])
