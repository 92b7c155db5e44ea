"""GTSAM's ISAM2 as what solves a stage again and again while it grows.

Kaess et al. (2012), "iSAM2: Incremental Smoothing and Mapping Using the Bayes Tree". A solve is compared with the one
before: factors that are new join the Bayes tree, those that are gone leave it, and only what they touch is linearized
and eliminated again. Nothing is marginalized: memory and the cost of a large change grow with all that was ever added.

A factor is the same one if its type, its variables and its measurements are; its information may drift by a fifth
before it is replaced. Every row is a factor of its own, since one that stacks rows would have to be replaced with every
observation.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import gtsam
import numpy as np

from uni4d_fg.errors import SolverError
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.state import State
from uni4d_fg.optim.gtsam_graph import Held, held_variables, row_factors, variables_read
from uni4d_fg.optim.gtsam_optimizers import gtsam_message, unfrozen
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage
from uni4d_fg.optim.summary import IterationRecord, SolveSummary, Termination

Signature: TypeAlias = tuple[Any, ...]

_NOISE_CHANGE = 0.2
"""Relative change of a factor's information at which it is replaced."""
_WORSE = 1e-3
"""Part by which the energy may rise before the tree is built anew: its factors' noise is a little out of date."""
_MOVED = 1e-9
"""Distance at which a held variable that somebody else has moved is held anew."""


@dataclass
class _InTree:
    """A factor in the Bayes tree."""

    index: int
    noise: float
    """Weight over squared sigma."""
    held: Held | None = None


@dataclass
class Isam2Runner:
    """A ``StageRunner`` that keeps its factor graph from solve to solve; for one growing problem."""

    relinearize_threshold: float = 1e-4
    """Entries of a step above this linearize their variable anew."""
    tree: gtsam.ISAM2 = field(init=False)
    _in_tree: dict[Signature, _InTree] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._plant()

    def __call__(self, stage: Stage, state: State, hooks: Hooks | None = None) -> tuple[State, SolveSummary]:
        """Bring the tree to what a stage says and return the estimate.

        The tree is updated until the energy falls by less than the stage's ``relative_decrease``, or
        ``max_iterations`` times.
        If the tree's estimate has a clearly higher energy than ``state``, it is built anew from there; what is returned
        is never higher.

        Raises:
            SolverError: If the linear system is singular, also in a new tree.
        """
        began = time.perf_counter()
        initial = stage.problem.energies(state)
        notes: dict[str, Any] = {"backend": "gtsam"}
        found, records, settled = self._solved(stage, state, began, again=False)
        if found is None or stage.problem.energy(found) > (1.0 + _WORSE) * sum(initial.values()):
            notes["rebuilt"] = True
            self._plant()
            found, records, settled = self._solved(stage, state, began, again=True)
        assert found is not None
        final, termination = stage.problem.energies(found), Termination.RELATIVE_DECREASE
        if sum(final.values()) > sum(initial.values()):
            found, final, termination = state, initial, Termination.STEP
        elif not settled:
            termination = Termination.MAX_ITERATIONS
        terms = tuple(dict.fromkeys(batch.name for batch in stage.problem.batches))
        notes["solved_by"] = [{"by": "GTSAM ISAM2", "terms": terms, "why": "smoother isam2"}]
        return found, SolveSummary(
            stage.name, termination, initial, final, tuple(records), {"total": time.perf_counter() - began},
            num_factors=len(self._in_tree), num_variables=self.tree.calculateEstimate().size(), notes=notes,
        )  # fmt: skip

    def _plant(self) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(self.relinearize_threshold)
        params.relinearizeSkip = 1
        self.tree, self._in_tree = gtsam.ISAM2(params), {}

    def _solved(
        self, stage: Stage, state: State, began: float, again: bool
    ) -> tuple[State | None, list[IterationRecord], bool]:
        """Return the estimate, None if the system was singular and may be tried again; the updates; if they settled."""
        solver = stage.solver
        graph, values, gone, signatures = self._changes(stage, state)
        records: list[IterationRecord] = []
        try:
            result = self.tree.update(graph, values, gone)
            for signature, index in zip(signatures, list(result.getNewFactorsIndices()), strict=True):
                self._in_tree[signature].index = int(index)
            while True:
                found = state.with_values(self.tree.calculateBestEstimate())
                found = unfrozen(stage.problem, state, found)
                energy = stage.problem.energy(found)
                records.append(IterationRecord(energy, time.perf_counter() - began, 0.0, 0, 0))
                settled = len(records) > 1 and energy > (1.0 - solver.relative_decrease) * records[-2].energy
                if settled or len(records) == solver.max_iterations:
                    return found, records, settled
                self.tree.update()
        except RuntimeError as error:
            if again:
                raise SolverError(f"{stage.name}: GTSAM ISAM2 failed: {gtsam_message(error)}") from error
            return None, [], False

    def _changes(
        self, stage: Stage, state: State
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[int], list[Signature]]:
        """Return new factors, new variables, the numbers of factors that leave, and what the new ones are known by."""
        graph, values, gone = gtsam.NonlinearFactorGraph(), gtsam.Values(), list[int]()
        new: list[Signature] = []
        seen: set[Signature] = set()
        for batch in stage.problem.batches:
            batch = batch.take(np.flatnonzero(batch.weight > 0))
            signatures, noise = _signatures(batch, state, seen), _noise(batch)
            rows = []
            for row, signature in enumerate(signatures):
                known = self._in_tree.get(signature)
                if known is not None:
                    if abs(noise[row] / known.noise - 1.0) < _NOISE_CHANGE:
                        continue
                    gone.append(known.index)
                self._in_tree[signature] = _InTree(-1, noise[row])
                new.append(signature)
                rows.append(row)
            for item in row_factors(batch.take(np.array(rows, dtype=np.int64)), state) if rows else ():
                graph.push_back(item)
        read = variables_read(stage.problem, state)
        for variable, held in held_variables(stage.problem, state, read):
            signature = ("held", held.key, held.sigma.tobytes())
            seen.add(signature)
            known = self._in_tree.get(signature)
            if known is not None and known.held is not None:
                if not held.is_whole or np.allclose(known.held.value, held.value, rtol=0.0, atol=_MOVED):
                    continue
                gone.append(known.index)
            self._in_tree[signature] = _InTree(-1, 1.0, held)
            new.append(signature)
            graph.push_back(held.prior(variable))
        for signature in [signature for signature in self._in_tree if signature not in seen]:
            gone.append(self._in_tree.pop(signature).index)
        for variable, rows_read in read.items():
            chosen = np.flatnonzero(rows_read)
            for row, key in zip(chosen.tolist(), variable.keys(state.numbers(variable)[chosen]), strict=True):
                if not self.tree.valueExists(key):
                    values.insert(key, variable.to_gtsam(state[variable][row]))
        return graph, values, gone, new


def _signatures(batch: FactorBatch, state: State, seen: set[Signature]) -> list[Signature]:
    """Return what every row is known by, and add it to ``seen``; equal factors are counted."""
    keys = [state.keys(slot.variable) for slot in batch.slots]
    columns = [[k[row] for row in slot.rows.tolist()] for k, slot in zip(keys, batch.slots, strict=True)]
    count = len(batch)
    data = np.concatenate([np.zeros((count, 0)), *(a.reshape(count, -1) for a in batch.data.values())], axis=1)
    kernel = (batch.kernel.kind, batch.kernel.threshold)
    out = []
    for row in range(count):
        signature: Signature = (batch.name, kernel, *(column[row] for column in columns), data[row].tobytes())
        while signature in seen:
            signature = (*signature, "again")
        seen.add(signature)
        out.append(signature)
    return out


def _noise(batch: FactorBatch) -> list[float]:
    """Return weight over squared sigma per row; the mean over entries where each has its own sigma."""
    squared = batch.sigma**2 if batch.sigma.ndim == 1 else (batch.sigma**2).mean(axis=1)
    noise: list[float] = (batch.weight / squared).tolist()
    return noise
