"""The benchmark of bundle adjustment: this package's solvers take its problem and end at the same cost."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("uni4d_fg_cpp")


@pytest.fixture
def benchmark() -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
        yield importlib.import_module("bundle_adjustment")


def test_both_solvers_end_at_the_same_cost(benchmark: Any) -> None:
    problem, state = benchmark.make_problem(3500)
    start = sum(problem.energies(state).values())
    cpp, python = (benchmark.solve_ours(problem, state, threads=2, cpp=cpp) for cpp in (True, False))
    assert cpp["cost"] == pytest.approx(python["cost"], rel=1e-6)
    # Two residuals of unit variance per observation, of which three in a hundred are gross errors; 0.5 r^2 each.
    assert cpp["cost"] < 0.1 * start
    assert cpp["cost"] < 2.5 * len(problem.batches[0])
