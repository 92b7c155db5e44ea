"""What the Levenberg-Marquardt driver asks of a problem, whatever solves its linear systems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

StateT = TypeVar("StateT")


@dataclass(frozen=True)
class Step:
    """A solution of the damped linear system."""

    delta: Any
    """Tangent step, in whatever form the objective's ``retract`` takes."""
    norm: float
    """Euclidean norm of the step."""
    predicted_decrease: float
    """Decrease of the quadratic model, >= 0."""
    inner_iterations: int = 0
    """Conjugate-gradient steps, for inexact solvers."""


class Linearization(Protocol):
    """The quadratic model at one point; solvable several times with different damping."""

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient."""
        ...

    def solve(self, damping: float) -> Step | None:
        """Return the step for ``H + damping * diag(H)``, or None when that is not positive definite."""
        ...


class Objective(Protocol[StateT]):
    """An energy with a linearisation."""

    def energies(self, state: StateT) -> dict[str, float]:
        """Return the energy per term."""
        ...

    def linearize(self, state: StateT) -> Linearization:
        """Return the quadratic model at ``state``."""
        ...

    def retract(self, state: StateT, delta: Any) -> StateT:
        """Return ``state`` moved by ``delta``."""
        ...

    def diagnose(self, state: StateT) -> str:
        """Return a sentence on why the linear system is singular at ``state``, with decoded variables."""
        ...
