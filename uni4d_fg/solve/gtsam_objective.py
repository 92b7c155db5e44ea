"""A problem as a GTSAM factor graph, solved by GTSAM's elimination: the backend 'gtsam'.

Factors that the wheel brings are used where a family has one, with the robust kernel as a
``noiseModel.Robust`` of their own; the factor's weight w is folded into them, ``sigma / sqrt(w)`` and
``threshold sqrt(w)``, which is exact for the kernels quadratic, huber and cauchy. Everything else is a custom
factor. Slow, and made for comparison: both paths share the driver and the energy.

One difference remains. Behind the camera and closer than the near plane, GTSAM's projection factors give a
constant or zero error without a gradient; ours continue the inverse depth and push the point to the front.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gtsam
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.custom_factor import CALIBRATION_ENTRIES, make_custom_factor
from uni4d_fg.factors.priors import INTRINSICS_PRIOR, LOG_SCALE_PRIOR
from uni4d_fg.factors.static_reprojection import STATIC_REPROJECTION
from uni4d_fg.factors.temporal_smoothness import VELOCITY_SMOOTHNESS
from uni4d_fg.graph.problem import Problem
from uni4d_fg.graph.state import TANGENT_DIM, State, values_at
from uni4d_fg.solve.gaussian_graph import GraphLinearization, GraphObjective

_HELD = 1e-6
"""Sigma of a frozen entry of a variable that moves otherwise, in the entry's unit."""
_LOOSE = 1e9
"""Sigma of an entry that a prior leaves alone."""


class GtsamObjective:
    """A :class:`Problem` on :class:`State` whose linear systems GTSAM solves."""

    def __init__(self, problem: Problem, state: State):
        """Make the factors once.

        Args:
            problem: Batches and free entries.
            state: Values of the frozen variables, and the names of all.
        """
        self.problem = problem
        self.free = problem.free_rows()
        self._terms: dict[str, gtsam.NonlinearFactorGraph] = {}
        self._constant = dict.fromkeys((batch.name for batch in problem.batches), 0.0)
        whole = gtsam.NonlinearFactorGraph()
        for batch in problem.batches:
            graph = self._terms.setdefault(batch.name, gtsam.NonlinearFactorGraph())
            for row in range(len(batch)):
                factor = self._factor(batch, row, state) if batch.weight[row] > 0 else None
                if factor is not None:
                    graph.push_back(factor)
                    whole.push_back(factor)
                elif batch.weight[row] > 0:
                    self._constant[batch.name] += batch.take(np.array([row])).energy(state)
        for factor in self._holding_priors(state):
            whole.push_back(factor)
        self._graph = GraphObjective(whole, term="graph")

    def energies(self, state: State) -> dict[str, float]:
        """Return the energy per term."""
        values = self._values(state)
        return {term: self._constant[term] + float(graph.error(values)) for term, graph in self._terms.items()}

    def linearize(self, state: State) -> GraphLinearization:
        """Linearise every factor.

        Raises:
            SolverError: If a factor is not finite; names its variables.
        """
        return self._graph.linearize(self._values(state))

    def retract(self, state: State, delta: gtsam.VectorValues) -> State:
        """Return ``state`` moved by ``delta``; frozen entries stay exactly as they are."""
        values = self._values(state).retract(delta)
        moved = {}
        for group, rows in self.free.items():
            out = state[group].copy()
            for row in np.flatnonzero(rows).tolist():
                key = state.key(group, row)
                if group == "intrinsics":
                    out[row] = values.atCal3_S2(key).vector()[CALIBRATION_ENTRIES]
                else:
                    out[row] = values_at(values, key, group)
            if group != "pose":
                out = np.where(self.problem.free[group], out, state[group])
            moved[group] = out
        return state.replace(**moved)

    def diagnose(self, state: State) -> str:
        """Name the variables that their factors leave undetermined."""
        return self._graph.diagnose(self._values(state))

    def _values(self, state: State) -> gtsam.Values:
        values = state.to_values({group: rows for group, rows in self.free.items() if group != "intrinsics"})
        for row in np.flatnonzero(self.free.get("intrinsics", np.zeros(0, dtype=bool))).tolist():
            values.insert(state.key("intrinsics", row), _calibration(state["intrinsics"][row]))
        return values

    def _factor(self, batch: FactorBatch, row: int, state: State) -> Any:
        """Return a native factor of one row where there is one, a custom factor otherwise; None for a constant."""
        free = [s.group in self.free and bool(self.free[s.group][s.rows[row]]) for s in batch.slots]
        keys = [state.key(s.group, int(s.rows[row])) for s in batch.slots]
        if batch.kernel.kind in ("quadratic", "huber", "cauchy"):
            family = batch.family
            if family is STATIC_REPROJECTION and free[0] and free[1]:
                uv, noise = batch.data["uv"][row], _noise(batch, row)
                if free[2]:
                    return gtsam.GeneralSFMFactor2Cal3_S2(uv, noise, keys[0], keys[1], keys[2])
                frozen = _calibration(state["intrinsics"][batch.slots[2].rows[row]])
                return gtsam.GenericProjectionFactorCal3_S2(uv, noise, keys[0], keys[1], frozen)
            if family is VELOCITY_SMOOTHNESS and all(free):
                return gtsam.BetweenFactorPoint3(keys[0], keys[1], np.zeros(3), _noise(batch, row))
            if family is LOG_SCALE_PRIOR and free[0]:
                return gtsam.PriorFactorVector(keys[0], batch.data["measured"][row], _noise(batch, row))
            if family is INTRINSICS_PRIOR and free[0] and batch.kernel.kind == "quadratic":
                sigma = np.full(5, _LOOSE)
                sigma[CALIBRATION_ENTRIES] = _sigma(batch, row)
                noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
                return gtsam.PriorFactorCal3_S2(keys[0], _calibration(batch.data["measured"][row]), noise)
        return make_custom_factor(batch.take(np.array([row])), state, self.free, calibrations=True)

    def _holding_priors(self, state: State) -> Iterator[Any]:
        """Yield what holds the frozen entries of variables that are free in part, and every skew."""
        for group, rows in self.free.items():
            mask = self.problem.free[group]
            for row in np.flatnonzero(rows).tolist():
                key, held = state.key(group, row), np.where(mask[row], _LOOSE, _HELD)
                if group == "intrinsics":
                    sigma = np.full(5, _HELD)
                    sigma[CALIBRATION_ENTRIES] = held
                    noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
                    yield gtsam.PriorFactorCal3_S2(key, _calibration(state["intrinsics"][row]), noise)
                elif not mask[row].all():
                    noise = gtsam.noiseModel.Diagonal.Sigmas(held)
                    if group == "pose":
                        yield gtsam.PriorFactorPose3(key, gtsam.Pose3(state["pose"][row]), noise)
                    else:
                        make = gtsam.PriorFactorPoint3 if TANGENT_DIM[group] == 3 else gtsam.PriorFactorVector
                        yield make(key, state[group][row], noise)


def _calibration(intrinsics: FloatArray) -> gtsam.Cal3_S2:
    fx, fy, cx, cy = intrinsics.tolist()
    return gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)


def _sigma(batch: FactorBatch, row: int) -> FloatArray:
    """Return the sigmas (d,) of one row with its weight folded in."""
    return np.broadcast_to(batch.sigma[row] / np.sqrt(batch.weight[row]), (batch.family.residual_dim,))


def _noise(batch: FactorBatch, row: int) -> gtsam.noiseModel.Base:
    """Return the noise and kernel of one row; w rho_c(s) = rho_{c sqrt(w)}(s sqrt(w)) for these kernels."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(_sigma(batch, row))
    if batch.kernel.kind == "quadratic":
        return noise
    threshold = float(batch.kernel.threshold * np.sqrt(batch.weight[row]))
    estimator = gtsam.noiseModel.mEstimator
    kernel = estimator.Huber(threshold) if batch.kernel.kind == "huber" else estimator.Cauchy(threshold)
    return gtsam.noiseModel.Robust.Create(kernel, noise)
