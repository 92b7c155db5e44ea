"""The one Levenberg-Marquardt loop: damping, gain ratio, termination, guards.

Damping follows Nielsen (1999), "Damping parameter in Marquardt's method": an accepted step with gain ratio
q scales the damping by max(1/3, 1 - (2q - 1)^3), a rejected one by a factor that doubles each time. A step
is accepted only if it lowers the energy, so that the energy never rises.

Once a step lowers the energy by little, objectives that know the curvature of their robust kernels are asked for it.

The damping diagonal has a floor, so that a variable which no factor determines stays where it is instead of
making the system singular. What remains singular at every damping is reported with the variables' names.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.optim.objective import CurvedObjective, Objective, Step
from uni4d_fg.optim.summary import IterationRecord, SolveSummary, Termination

StateT = TypeVar("StateT")

_MIN_GAIN = 1e-4
"""A step is accepted that brings this part of the predicted decrease, or more."""
_MIN_DAMPING = 1e-12
"""Below, damping no longer changes a step in double precision."""
_NEAR = 2e-3
"""A step that lowers the energy by less than this part is near the minimum."""


@dataclass
class Hooks:
    """How a caller watches and stops a solve."""

    on_iteration: Callable[[str, int, float], None] | None = None
    """Called with (name, iteration, energy) after every accepted step."""
    should_stop: Callable[[], bool] | None = None
    """Polled before every linearization; True ends the solve with the best state so far."""
    on_state: Callable[[Any], None] | None = None
    """Called with the state after every accepted step; states are never modified afterwards."""


@dataclass
class _Clock:
    phases: dict[str, float] = field(default_factory=lambda: {"linearize": 0.0, "solve": 0.0, "evaluate": 0.0})
    start: float = field(default_factory=time.perf_counter)

    def add(self, phase: str, since: float) -> None:
        self.phases[phase] += time.perf_counter() - since

    def elapsed(self) -> float:
        return time.perf_counter() - self.start


def minimize(
    objective: Objective[StateT],
    state: StateT,
    config: SolverConfig,
    *,
    name: str = "solve",
    hooks: Hooks | None = None,
) -> tuple[StateT, SolveSummary]:
    """Minimize an objective from ``state``.

    Args:
        objective: Energy, linearization and retraction.
        state: Starting point; not modified.
        config: Tolerances, damping and limits.
        name: Name of the solve in the summary and in messages.
        hooks: Progress and cancellation.

    Returns:
        The best state found, and a summary. The final energy is never above the initial one.

    Raises:
        SolverError: If the energy at the start is not finite, or the system is singular at every damping;
            the message names the variables concerned.
    """
    hooks = hooks or Hooks()
    clock = _Clock()
    initial = energies = _evaluate(objective, state, clock)
    energy = sum(energies.values())
    if not math.isfinite(energy):
        bad = [term for term, value in energies.items() if not math.isfinite(value)]
        objective.linearize(state)  # names the offending factor
        raise SolverError(f"{name}: the starting energy of {', '.join(bad)} is not finite")

    damping, growth = config.initial_damping, 2.0
    curved = objective if isinstance(objective, CurvedObjective) else None
    near = False
    records: list[IterationRecord] = []
    termination = Termination.MAX_ITERATIONS
    while len(records) < config.max_iterations:
        if hooks.should_stop is not None and hooks.should_stop():
            termination = Termination.CANCELLED
            break
        if energy == 0.0:
            termination = Termination.ZERO_ENERGY
            break
        began = time.perf_counter()
        linearization = curved.linearize_curved(state) if curved is not None and near else objective.linearize(state)
        clock.add("linearize", began)
        if linearization.gradient_max <= config.gradient_tolerance:
            termination = Termination.GRADIENT
            break

        accepted, rejected, trial_energies = None, 0, energies
        while accepted is None:
            began = time.perf_counter()
            step = linearization.solve(damping)
            clock.add("solve", began)
            if step is not None:
                if step.norm <= config.step_tolerance:
                    break
                trial = objective.retract(state, step.delta)
                trial_energies = _evaluate(objective, trial, clock)
                gain = _gain(energy, sum(trial_energies.values()), step)
                if gain > _MIN_GAIN:
                    accepted = trial
                    damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), _MIN_DAMPING)
                    growth = 2.0
                    continue
                if step.predicted_decrease <= 1e-14 * energy:
                    break
            rejected += 1
            damping *= growth
            growth *= 2.0
            if damping > config.max_damping:
                break
        if accepted is None:
            if step is None:
                raise SolverError(f"{name}: the linear system is singular. {objective.diagnose(state)}")
            small = step.norm <= config.step_tolerance or step.predicted_decrease <= 1e-14 * energy
            termination = Termination.STEP if small else Termination.DAMPING_LIMIT
            break
        trial_energy = sum(trial_energies.values())
        decrease = (energy - trial_energy) / energy
        near = near or decrease < _NEAR
        state, energies, energy = accepted, trial_energies, trial_energy
        assert step is not None
        records.append(IterationRecord(energy, clock.elapsed(), damping, rejected, step.inner_iterations))
        if hooks.on_state is not None:
            hooks.on_state(state)
        if hooks.on_iteration is not None:
            hooks.on_iteration(name, len(records), energy)
        if decrease < config.relative_decrease:
            termination = Termination.RELATIVE_DECREASE
            break
    seconds = {**clock.phases, "total": clock.elapsed()}
    return state, SolveSummary(name, termination, initial, energies, tuple(records), seconds)


def _evaluate(objective: Objective[StateT], state: StateT, clock: _Clock) -> dict[str, float]:
    began = time.perf_counter()
    # A step may lead where a factor is not defined, such as to a negative focal length: it is rejected, not warned of.
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        energies = objective.energies(state)
    clock.add("evaluate", began)
    return energies


def _gain(before: float, after: float, step: Step) -> float:
    """Return actual over predicted decrease; negative for a non-finite trial."""
    if not math.isfinite(after) or after >= before:
        return -1.0
    return min((before - after) / max(step.predicted_decrease, 1e-300), 1.0)
