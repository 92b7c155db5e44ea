"""What a solver reports: it never prints, and never returns nothing on failure."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Any


class Termination(str, Enum):
    """Why a solve ended."""

    RELATIVE_DECREASE = "converged: relative decrease below tolerance"
    GRADIENT = "converged: gradient below tolerance"
    STEP = "converged: step below tolerance"
    ZERO_ENERGY = "converged: energy is zero"
    NOTHING_TO_DO = "nothing to optimize: no factor reads a free variable"
    MAX_ITERATIONS = "stopped: iteration limit"
    DAMPING_LIMIT = "stopped: no damping gives a lower energy"
    EARLY_STOPPED = "stopped: no progress for the patience"
    CANCELLED = "stopped: cancelled"


@dataclass(frozen=True)
class IterationRecord:
    """One linearization and the accepted step that followed it; of a descent, one step."""

    energy: float
    """After the step; of a descent the loss before it."""
    seconds: float
    """Time since the start of the solve."""
    damping: float
    rejected: int
    """Rejected trial steps before the accepted one."""
    inner_iterations: int


@dataclass(frozen=True)
class SolveSummary:
    """Outcome of one solve."""

    name: str
    termination: Termination
    initial_energies: dict[str, float]
    """Energy per term at the start."""
    final_energies: dict[str, float]
    """Energy per term at the end: Levenberg-Marquardt never ends higher in total than it starts."""
    iterations: tuple[IterationRecord, ...]
    """One record per accepted step."""
    seconds: dict[str, float]
    """Wall time per phase ('linearize', 'solve' and 'evaluate', or 'prepare' and 'descend') and 'total'."""
    num_factors: int = 0
    num_variables: int = 0
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def initial_energy(self) -> float:
        """Total energy at the start."""
        return sum(self.initial_energies.values())

    @property
    def final_energy(self) -> float:
        """Total energy at the end."""
        return sum(self.final_energies.values())

    @property
    def converged(self) -> bool:
        """Whether a tolerance ended the solve."""
        return self.termination.value.startswith(("converged", "nothing"))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        out = {f.name: getattr(self, f.name) for f in fields(self)}
        out["termination"] = self.termination.value
        out["iterations"] = [vars(record) for record in self.iterations]
        out["initial_energy"], out["final_energy"] = self.initial_energy, self.final_energy
        return out
