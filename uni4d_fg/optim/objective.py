"""What the Levenberg-Marquardt driver asks of a problem, whatever solves its linear systems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

from uni4d_fg.optim.problem import Problem

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


@dataclass(frozen=True)
class SolvedPart:
    """Which factors something linearizes and solves."""

    by: str
    """What does it: "C++ landmark elimination"."""
    terms: tuple[str, ...]
    """Names of the terms; none means that it has nothing to do."""
    why: str = ""
    """Why not something faster; empty where this is the fastest."""


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
    """An energy with a linearization."""

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

    def parts(self) -> list[SolvedPart]:
        """Return what solves which terms."""
        ...


@runtime_checkable
class CurvedObjective(Protocol):
    """An objective that also has a model for the end of a solve.

    Reweighted least squares takes the weights of robust kernels for constant. Its steps are safe from afar and too
    short near the minimum, where it converges linearly.
    """

    def linearize_curved(self, state: Any) -> Linearization:
        """Return the quadratic model at ``state`` that accounts for how the kernels' weights change.

        The gradient is that of ``linearize``, and the model is positive semidefinite as well.
        """
        ...


@runtime_checkable
class Reweightable(Protocol):
    """An objective whose plan outlives a change of weights and kernels."""

    def reweight(self, problem: Problem) -> None:
        """Solve ``problem`` from now on, which has the same factors with other weights and kernels."""
        ...
