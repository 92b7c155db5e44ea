"""A stage solved by Adam: takes the declarations of Levenberg-Marquardt and returns the same kind of result."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from uni4d_fg.config.adam import AdamConfig, AdamScheduleConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.priors import scale_anchor
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import POSE
from uni4d_fg.optim.adam.descent import Trace, descend
from uni4d_fg.optim.adam.energy import TorchEnergy
from uni4d_fg.optim.adam.parameters import Parameters
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage
from uni4d_fg.optim.summary import IterationRecord, SolveSummary, Termination
from uni4d_fg.optim.threads import current_limit
from uni4d_fg.optional import import_torch


@dataclass(frozen=True)
class AdamRunner:
    """Solves stages by Adam; a ``StageRunner``.

    Raises:
        MissingDependencyError: On construction, if PyTorch is not installed.
        SolverError: On construction, if the configuration asks for a GPU and there is none.
    """

    config: AdamConfig = field(default_factory=AdamConfig)
    torch: Any = field(default_factory=import_torch, repr=False)

    def __post_init__(self) -> None:
        if self.config.device == "cuda" and not self.torch.cuda.is_available():
            raise SolverError("adam.device is 'cuda', but PyTorch finds no GPU: set it to 'cpu' or 'auto'")
        limit = current_limit()
        if limit is not None:
            self.torch.set_num_threads(limit)

    @property
    def device(self) -> str:
        """Where the descent runs."""
        if self.config.device == "auto":
            return "cuda" if self.torch.cuda.is_available() else "cpu"
        return self.config.device

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Solve a stage from ``state``; energies in the summary are scored in double precision by NumPy.

        A 'norm' kernel counts as the plain norm during the descent, and the stage's annealing is not used.

        Raises:
            SolverError: If the energy is not finite, at the start or later.
        """
        stage, state = self._adapted(stage, state)
        initial = _finite_energies(stage, state)
        if not stage.reads_free_variables:
            return state, SolveSummary(stage.name, Termination.NOTHING_TO_DO, initial, initial, (), {"total": 0.0})
        began = time.perf_counter()
        torch, config = self.torch, self.config
        dtype = getattr(torch, config.precision)
        with self._deterministic():
            parameters = Parameters.create(torch, state, stage.problem.free, dtype, self.device)
            energy = TorchEnergy(torch, stage.problem.batches, state, parameters.moving, dtype, self.device)
            prepared = time.perf_counter()
            trace = descend(
                torch, parameters.values, lambda: energy(parameters.current()), schedule_of(stage.kind, config),
                amsgrad=config.amsgrad, keep_best=config.keep_best, name=stage.name, hooks=hooks,
            )  # fmt: skip
        solved = parameters.to_state(trace.best)
        seconds = {"prepare": prepared - began, "descend": time.perf_counter() - prepared}
        return solved, self._summary(stage, initial, solved, trace, seconds)

    def _adapted(self, stage: Stage, state: State) -> tuple[Stage, State]:
        stage = stage.unbounded()
        if not self.config.scale_anchor:
            kept = tuple(batch for batch in stage.problem.batches if batch.factor_type is not scale_anchor)
            stage = replace(stage, problem=replace(stage.problem, batches=kept))
        if self.config.reference_windows and stage.kind == "camera_init":
            return reference_window(stage, state)
        return stage, state

    @contextmanager
    def _deterministic(self) -> Iterator[None]:
        """Make sums on a GPU reproducible for the time of a solve."""
        torch = self.torch
        if self.device == "cpu" or not self.config.deterministic:
            yield
            return
        enabled = torch.are_deterministic_algorithms_enabled()
        warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
        torch.use_deterministic_algorithms(True, warn_only=True)
        try:
            yield
        finally:
            torch.use_deterministic_algorithms(enabled, warn_only=warn_only)

    def _summary(
        self, stage: Stage, initial: dict[str, float], state: State, trace: Trace, seconds: dict[str, float]
    ) -> SolveSummary:
        records = (IterationRecord(loss, at, 0.0, 0, 0) for loss, at in zip(trace.losses, trace.seconds, strict=True))
        notes = {
            "solver": "adam",
            "device": self.device,
            "precision": self.config.precision,
            "learning_rates": trace.learning_rates,
        }
        return SolveSummary(
            stage.name,
            trace.termination,
            initial,
            stage.problem.energies(state),
            tuple(records),
            {**seconds, "total": sum(seconds.values())},
            num_factors=sum(len(batch) for batch in stage.problem.batches),
            num_variables=sum(int(rows.sum()) for rows in stage.problem.free_rows().values()),
            notes=notes,
        )


def schedule_of(kind: str, config: AdamConfig) -> AdamScheduleConfig:
    """Return the schedule of a kind of stage; that of bundle adjustment for stages without their own."""
    schedules = {"camera_init": config.camera_init, "nonrigid": config.nonrigid}
    return schedules.get(kind, config.bundle_adjustment)


def reference_window(stage: Stage, state: State) -> tuple[Stage, State]:
    """Return a window of stage 1 as in the reference program.

    Every frame of the window moves but frame 0, and the newest starts at the pose of the frame before it.
    """
    rows = np.unique(np.concatenate([s.rows for b in stage.problem.batches for s in b.slots if s.variable == POSE]))
    problem = stage.problem
    free, poses = problem.free[POSE].copy(), state[POSE].copy()
    free[rows[rows > 0]] = True
    newest = int(rows[-1])
    poses[newest] = poses[max(newest - 1, 0)]
    problem = replace(problem, free={**problem.free, POSE: free})
    return replace(stage, problem=problem), state.replace({POSE: poses})


def _finite_energies(stage: Stage, state: State) -> dict[str, float]:
    """Return the energies at the start.

    Raises:
        SolverError: If one is not finite; names the factor.
    """
    energies = stage.problem.energies(state)
    for batch in stage.problem.batches:
        if not math.isfinite(energies[batch.name]):
            batch.check(*batch.factor_type.linearize(*batch.gather(state), **batch.data), state)
    bad = [name for name, value in energies.items() if not np.isfinite(value)]
    if bad:
        raise SolverError(f"{stage.name}: the starting energy of {', '.join(bad)} is not finite")
    return energies
