"""A factor type of one's own that has the name of one of the package never gets that one's C++ kernel."""

from __future__ import annotations

import subprocess
import sys

import pytest

from uni4d_fg.optim.extension import find_extension

OWN = """
import numpy as np
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import LANDMARK
from uni4d_fg.optim.extension import linearize_batch

@factor(LANDMARK, LANDMARK, LANDMARK, dim=3)
def {name}(before, here, after):
    return after - before

points = np.array([[1.0, 0.0, 0.0], [5.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
print(linearize_batch({name}(0, 1, np.array([2])), State({{LANDMARK: points}}))[0])
"""


@pytest.mark.skipif(find_extension()[0] is None, reason="needs the C++ extension")
def test_the_name_of_a_compiled_type_is_refused_and_another_is_computed_as_declared() -> None:
    def run(name: str) -> subprocess.CompletedProcess[str]:
        # A process of its own: the type has to be declared before those of the package are loaded.
        return subprocess.run(
            [sys.executable, "-c", OWN.format(name=name)], capture_output=True, text=True, check=False
        )  # fmt: skip

    taken = run("acceleration_smoothness")
    assert taken.returncode != 0
    assert "SolverError: factor type 'acceleration_smoothness' is declared in __main__ already" in taken.stderr
    assert run("my_acceleration_smoothness").stdout.strip() == "[[1. 0. 0.]]"
