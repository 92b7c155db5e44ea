"""GTSAM's own optimizers on the graph of a problem: Levenberg-Marquardt and Dogleg.

    optimizer: gtsam_levenberg_marquardt        # any stage's solver

They run one iteration at a time on ``to_gtsam(problem, state)``, so that a solve can be cancelled, reports every
iteration and ends by the tolerances that ours ends by. What GTSAM does by default and is changed here:

- It damps with the identity, whose effect depends on the variables' units. With ``diagonalDamping`` it damps diag(H).
- It ends a solve at a relative decrease of 1e-5 or an absolute one of 1e-5, whatever the energy's size, and gives up a
  search for the damping at the first trial that changes the energy by less. The absolute tolerance is off, the
  relative one lies below that of the configuration.
- A point behind a camera costs nothing in its projection factors. Where a solve ends in a state whose energy is not
  that of the graph, it is repeated with custom factors, which push such a point back.

A custom factor costs a copy of all values per callback here: small problems only, see docs/gtsam.md.
"""

from __future__ import annotations

import math
import re
import time
from typing import Any, Literal

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import describe
from uni4d_fg.optim.gtsam_graph import to_gtsam, variables_read
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.objective import SolvedPart
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.summary import IterationRecord, SolveSummary, Termination

GtsamOptimizer = Literal["gtsam_levenberg_marquardt", "gtsam_dogleg"]
NAMES: dict[GtsamOptimizer, str] = {
    "gtsam_levenberg_marquardt": "GTSAM LevenbergMarquardtOptimizer",
    "gtsam_dogleg": "GTSAM DoglegOptimizer",
}
_SEARCH = 1e-3
"""The search for a damping or radius goes on until trials change the energy by less than this part of the tolerance."""
_SMALLEST_RADIUS = 1e-12
_EQUAL = 1e-6
"""Largest relative difference of the graph's error and the problem's energy."""


def minimize_with_gtsam(
    problem: Problem,
    state: State,
    config: SolverConfig,
    *,
    name: str = "solve",
    hooks: Hooks | None = None,
) -> tuple[State, SolveSummary]:
    """Minimize a problem by the optimizer of GTSAM's that the configuration names.

    Args:
        problem: Factors and free entries.
        state: Starting point; not modified.
        config: Optimizer, iteration limit, relative decrease, initial and largest damping.
        name: Name of the solve in the summary and in messages.
        hooks: Progress and cancellation, polled between two iterations.

    Returns:
        The state found, frozen entries exactly as they were, and a summary whose iterations are GTSAM's. The final
        energy is never above the initial one.

    Raises:
        SolverError: If the energy at the start or a factor is not finite, or the linear system is singular.
    """
    began, hooks = time.perf_counter(), hooks or Hooks()
    initial = problem.energies(state)
    if not np.isfinite(sum(initial.values())):
        bad = [term for term, value in initial.items() if not np.isfinite(value)]
        raise SolverError(f"{name}: the starting energy of {', '.join(bad)} is not finite")
    for native in (True, False):
        solve = _Solve(problem, state, config, name, hooks, native, began)
        found, records, termination = solve.run()
        final = problem.energies(found)
        if not native or math.isclose(sum(final.values()), solve.error(found), rel_tol=_EQUAL):
            break
    if sum(final.values()) > sum(initial.values()):
        found, final, records = state, initial, []
    seconds = {"total": time.perf_counter() - began}
    notes = {"backend": "gtsam"}
    if not native:
        notes["gtsam_factors"] = "custom: a point went behind a camera, where GTSAM's own cost nothing"
    return found, SolveSummary(name, termination, initial, final, tuple(records), seconds, notes=notes)


def gtsam_parts(problem: Problem, config: SolverConfig) -> list[SolvedPart]:
    """Return that the optimizer does everything."""
    terms = tuple(dict.fromkeys(batch.name for batch in problem.batches))
    return [SolvedPart(NAMES[_chosen(config)], terms, f"optimizer {config.optimizer}")]


def unfrozen(problem: Problem, start: State, found: State) -> State:
    """Return ``found`` with every frozen entry as in ``start``: tight priors give way a little."""
    arrays: dict[Any, FloatArray] = {}
    for variable, array in start.arrays.items():
        mask = problem.free.get(variable)
        if mask is None or not mask.any():
            arrays[variable] = array
        elif mask.all():
            arrays[variable] = found[variable]
        else:
            step = np.where(mask, variable.manifold.local(array, found[variable]), 0.0)
            moved = variable.manifold.retract(array, step)
            full = mask.all(axis=1).reshape(-1, *(1,) * (array.ndim - 1))
            none = ~mask.any(axis=1).reshape(-1, *(1,) * (array.ndim - 1))
            arrays[variable] = np.where(full, found[variable], np.where(none, array, moved))
    return State(arrays, start.index)


class _Solve:
    """One run of an optimizer on one form of the graph."""

    def __init__(
        self, problem: Problem, state: State, config: SolverConfig, name: str, hooks: Hooks, native: bool, began: float
    ):
        self.problem, self.start, self.config, self.name, self.hooks = problem, state, config, name, hooks
        self.began = began
        self.graph, values = to_gtsam(problem, state, native=native)
        self._read = variables_read(problem, state)
        self.is_dogleg = _chosen(config) == "gtsam_dogleg"
        self.optimizer = (_dogleg if self.is_dogleg else _levenberg_marquardt)(self.graph, values, config)

    def error(self, state: State) -> float:
        """Return the graph's error at a state."""
        return float(self.graph.error(state.to_values(self._read)))

    def run(self) -> tuple[State, list[IterationRecord], Termination]:
        """Return the state, the iterations and why it ended."""
        optimizer, hooks, records = self.optimizer, self.hooks, list[IterationRecord]()
        energy = float(optimizer.error())
        termination = Termination.MAX_ITERATIONS
        while len(records) < self.config.max_iterations:
            if hooks.should_stop is not None and hooks.should_stop():
                termination = Termination.CANCELLED
                break
            if energy == 0.0:
                termination = Termination.ZERO_ENERGY
                break
            before = self._damping()
            try:
                optimizer.iterate()
            except RuntimeError as error:
                raise SolverError(
                    f"{self.name}: {NAMES[_chosen(self.config)]} failed: {gtsam_message(error)}"
                ) from error
            after, damping = float(optimizer.error()), self._damping()
            if not after < energy:
                termination = self._gave_up(damping)
                break
            decrease, energy = (energy - after) / energy, after
            rejected = 0 if damping <= before or self.is_dogleg else 1
            records.append(IterationRecord(energy, time.perf_counter() - self.began, damping, rejected, 0))
            if hooks.on_state is not None:
                hooks.on_state(self._state())
            if hooks.on_iteration is not None:
                hooks.on_iteration(self.name, len(records), energy)
            if decrease < self.config.relative_decrease:
                termination = Termination.RELATIVE_DECREASE
                break
        return self._state(), records, termination

    def _state(self) -> State:
        return unfrozen(self.problem, self.start, self.start.with_values(self.optimizer.values()))

    def _damping(self) -> float:
        """Return the damping, or the radius of the trust region."""
        return float(self.optimizer.getDelta() if self.is_dogleg else self.optimizer.lambda_())

    def _gave_up(self, damping: float) -> Termination:
        """Tell why an iteration did not lower the energy."""
        spent = damping < _SMALLEST_RADIUS if self.is_dogleg else damping >= self.config.max_damping
        return Termination.DAMPING_LIMIT if spent else Termination.STEP


def _levenberg_marquardt(graph: Any, values: Any, config: SolverConfig) -> Any:
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setlambdaInitial(config.initial_damping)
    params.setlambdaUpperBound(config.max_damping)
    params.setRelativeErrorTol(_SEARCH * config.relative_decrease)
    params.setAbsoluteErrorTol(0.0)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params)


def _dogleg(graph: Any, values: Any, config: SolverConfig) -> Any:
    params = gtsam.DoglegParams()
    params.setRelativeErrorTol(_SEARCH * config.relative_decrease)
    params.setAbsoluteErrorTol(0.0)
    return gtsam.DoglegOptimizer(graph, values, params)


def _chosen(config: SolverConfig) -> GtsamOptimizer:
    if config.optimizer == "levenberg_marquardt":
        raise SolverError("optimizer 'levenberg_marquardt' is this package's own, not one of GTSAM's")
    return config.optimizer


def gtsam_message(error: RuntimeError) -> str:
    """Return what GTSAM says in one line, without its advice, and with the variable in words."""
    text = str(error).strip().split("\n\n", 1)[0].split("Thrown when", 1)[0]
    named = re.sub(r"(\d{15,}) \(Symbol: [^)]*\)", lambda found: describe(int(found[1])), text)
    return " ".join(named.split())
