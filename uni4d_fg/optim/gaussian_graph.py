"""GTSAM's elimination as the linear solver: any nonlinear factor graph under our driver.

The graph is linearized on a ``Values`` that Python holds, so that custom factors cost the same however many
variables there are; inside GTSAM's own optimizers every callback copies all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import gtsam
import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.errors import SolverError
from uni4d_fg.factors.variable import describe
from uni4d_fg.optim.diagnosis import listing, undetermined
from uni4d_fg.optim.objective import SolvedPart, Step

OrderingKind = Literal["colamd", "metis", "natural"]
_NONE = np.zeros(0, dtype=bool)


class GraphObjective:
    """A ``gtsam.NonlinearFactorGraph`` as an objective on ``gtsam.Values``."""

    def __init__(
        self,
        graph: gtsam.NonlinearFactorGraph,
        ordering: gtsam.Ordering | OrderingKind = "colamd",
        term: str = "graph",
        config: SolverConfig | None = None,
        moves: Mapping[int, BoolArray] | None = None,
    ):
        """Choose the elimination ordering once.

        Args:
            graph: Native and custom factors.
            ordering: An ordering, or how to compute one: 'colamd', 'metis', or 'natural' (key order).
            term: Name of the energy in summaries.
            config: Bounds of the damping diagonal.
            moves: Entries (dim,) per key that may move, where tight priors hold the others: a gradient there and the
                little by which they give way are none of the problem's. All when None.
        """
        self.moves = moves
        self.graph, self.term, self.config = graph, term, config or SolverConfig()
        if ordering == "colamd":
            ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
        elif ordering == "metis":
            ordering = gtsam.Ordering.MetisNonlinearFactorGraph(graph)
        elif ordering == "natural":
            ordering = _natural(graph)
        self.ordering = ordering
        self._shapes_checked = False

    def energies(self, state: gtsam.Values) -> dict[str, float]:
        """Return the graph's error."""
        return {self.term: float(self.graph.error(state))}

    def retract(self, state: gtsam.Values, delta: gtsam.VectorValues) -> gtsam.Values:
        """Return ``state`` moved by ``delta``."""
        return state.retract(delta)

    def linearize(self, state: gtsam.Values) -> GraphLinearization:
        """Linearize every factor.

        Raises:
            SolverError: If a factor is not finite or its Jacobian has the wrong width; names its variables.
        """
        gaussian = self.graph.linearize(state)
        if not self._shapes_checked:
            self._check_shapes(gaussian, _dimensions(state))
            self._shapes_checked = True
        gradient = gaussian.gradientAtZero()
        keys = [key for key in list(state.keys()) if gradient.exists(key)]
        vector = gradient.vector(keys)
        if not np.isfinite(vector).all():
            raise SolverError(self._blame(state))
        moves = None if self.moves is None else np.concatenate([self.moves[key] for key in keys] or [_NONE])
        return GraphLinearization(gaussian, self.ordering, keys, np.asarray(vector), self.config, moves)

    def _blame(self, state: gtsam.Values) -> str:
        for i in range(self.graph.size()):
            factor = self.graph.at(i)
            if factor is not None and not math.isfinite(factor.error(state)):
                names = " and ".join(describe(key) for key in list(factor.keys()))
                return f"{self.term}: factor {i} on {names} is not finite. Check the values it measures."
        return f"{self.term}: a Jacobian is not finite"

    def _check_shapes(self, gaussian: gtsam.GaussianFactorGraph, dimension: dict[int, int]) -> None:
        """Refuse Jacobians whose width is not the variable's: GTSAM itself computes on with them."""
        for i in range(gaussian.size()):
            factor = gaussian.at(i)
            if factor is None:
                continue
            keys = list(factor.keys())
            width, expected = _width(factor), sum(dimension[key] for key in keys)
            if width != expected:
                names = " and ".join(describe(key) for key in keys)
                raise SolverError(
                    f"{self.term}: the Jacobian of factor {i} on {names} has {width} columns, not {expected}"
                )

    def parts(self) -> list[SolvedPart]:
        """Return that GTSAM does everything."""
        return [SolvedPart("GTSAM elimination", (self.term,))]

    def diagnose(self, state: gtsam.Values) -> str:
        """Name the variables whose own information is singular and the factors that touch them."""
        gaussian = self.graph.linearize(state)
        dimension = _dimensions(state)
        blocks = {key: np.zeros((n, n)) for key, n in dimension.items()}
        touching: dict[int, list[int]] = {key: [] for key in dimension}
        for i in range(gaussian.size()):
            factor = gaussian.at(i)
            if factor is None:
                continue
            information, start = factor.information(), 0
            for key in list(factor.keys()):
                stop = start + dimension[key]
                blocks[key] += information[start:stop, start:stop]
                touching[key].append(i)
                start = stop
        # A variable that no factor reads is not part of the system.
        read = [key for key in blocks if touching[key]]
        weak = [key for key in read if len(undetermined(blocks[key][None]))]
        described = [f"{describe(key)} (factors: {', '.join(map(str, touching[key]))})" for key in weak[:5]]
        return listing(described, len(weak))


def _dimensions(state: gtsam.Values) -> dict[int, int]:
    zero = state.zeroVectors()
    return {key: len(zero.at(key)) for key in list(state.keys())}


def _width(factor: gtsam.GaussianFactor) -> int:
    if isinstance(factor, gtsam.JacobianFactor):
        return int(factor.cols()) - 1
    return len(factor.information())


def _natural(graph: gtsam.NonlinearFactorGraph) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for key in sorted(graph.keyVector()):
        ordering.push_back(key)
    return ordering


class GraphLinearization:
    """A Gaussian factor graph and its gradient at one point."""

    def __init__(
        self,
        gaussian: gtsam.GaussianFactorGraph,
        ordering: gtsam.Ordering,
        keys: list[int],
        gradient: FloatArray,
        config: SolverConfig,
        moves: BoolArray | None = None,
    ):
        self.gaussian, self.ordering, self.keys, self.moves = gaussian, ordering, keys, moves
        self.gradient = gradient if moves is None else np.where(moves, gradient, 0.0)
        # Rows (row, column, value), counted from 1, columns in the order of the keys; the last one is the right side.
        _, column, value = gaussian.sparseJacobian_()
        place, size = column.astype(np.int64) - 1, len(gradient)
        inside = place < size
        diagonal = np.bincount(place[inside], value[inside] ** 2, size)
        self._damping = np.clip(diagonal, config.min_diagonal, config.max_diagonal)
        self._zero = gtsam.VectorValues.Zero(gaussian.gradientAtZero())

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient."""
        return float(np.abs(self.gradient).max(initial=0.0))

    def solve(self, damping: float) -> Step | None:
        """Return the step of ``H + damping diag(H)``, or None when it is singular.

        Not GTSAM's default ``H + damping I``, whose effect depends on the units of the variables: with it a bundle
        adjustment of pixels, radians and meters creeps, and tolerances end it early.
        """
        damped = gtsam.GaussianFactorGraph()
        damped.push_back(self.gaussian)
        zero = self._zero
        start = 0
        for key in self.keys:
            n = len(zero.at(key))
            root = np.diag(np.sqrt(damping * self._damping[start : start + n]))
            start += n
            damped.push_back(gtsam.JacobianFactor(key, root, np.zeros(n), gtsam.noiseModel.Unit.Create(n)))
        try:
            delta = damped.optimize(self.ordering)
        except RuntimeError:
            return None
        vector = np.asarray(delta.vector(self.keys))
        if not np.isfinite(vector).all():
            return None
        if self.moves is not None:
            vector = np.where(self.moves, vector, 0.0)
            delta = self._vector_values(vector)
        decrease = float(self.gaussian.error(zero) - self.gaussian.error(delta))
        return Step(delta, float(np.linalg.norm(vector)), max(decrease, 0.0))

    def _vector_values(self, vector: FloatArray) -> gtsam.VectorValues:
        out, start = gtsam.VectorValues(), 0
        for key in self.keys:
            stop = start + len(self._zero.at(key))
            out.insert(key, vector[start:stop])
            start = stop
        return out
