"""Every entry point of the extension that takes arrays, with valid arguments to start from.

An entry is a function of named arguments and a maker of valid ones. `test_boundary.py` spoils one argument at a
time; a new entry point is covered by adding a line here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from families import FAMILIES, VARIABLE_NAMES, arguments_of
from uni4d_fg_cpp import _core


@dataclass(frozen=True)
class EntryPoint:
    """A callable and how to make valid keyword arguments for it; only the arrays among them are spoilt."""

    call: Callable[..., Any]
    make: Callable[[np.random.Generator], dict[str, Any]]
    negative: tuple[str, ...] = ()
    """Float arguments for which a negative value must be refused."""


def _noise(rng: np.random.Generator, count: int) -> dict[str, Any]:
    return {"sigma": rng.uniform(0.5, 2, count), "weight": rng.uniform(0, 2, count), "kernel": 1, "threshold": 1.3}


def _family(name: str, suffix: str) -> EntryPoint:
    positive = tuple(n for n in ("depth", "floor") if n in FAMILIES[name].data)
    return EntryPoint(getattr(_core, f"{name}_{suffix}"), lambda rng: arguments_of(name, rng, 5), positive)


ENTRY_POINTS: dict[str, EntryPoint] = {
    f"{name}_{suffix}": _family(name, suffix) for name in VARIABLE_NAMES for suffix in ("residual", "linearize")
}
ENTRY_POINTS["robust_energy"] = EntryPoint(
    _core.robust_energy, lambda rng: {"residual": rng.normal(size=(5, 3)), **_noise(rng, 5)}, ("sigma", "weight")
)
ENTRY_POINTS["whiten"] = EntryPoint(
    lambda residual, jacobians, **noise: _core.whiten(residual, [jacobians], **noise),
    lambda rng: {"residual": rng.normal(size=(5, 3)), "jacobians": rng.normal(size=(5, 3, 6)), **_noise(rng, 5)},
    ("sigma", "weight"),
)
