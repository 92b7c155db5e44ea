"""GTSAM's elimination as the linear solver: any nonlinear factor graph under our driver.

The graph is linearised on a ``Values`` that Python holds, so that custom factors cost the same however many
variables there are; inside GTSAM's own optimisers every callback copies all of them.
"""

from __future__ import annotations

import math
from typing import Literal

import gtsam
import numpy as np

from uni4d_fg.errors import SolverError
from uni4d_fg.graph.keys import decode
from uni4d_fg.solve.objective import Step

OrderingKind = Literal["colamd", "metis", "natural"]


class GraphObjective:
    """A ``gtsam.NonlinearFactorGraph`` as an objective on ``gtsam.Values``."""

    def __init__(
        self, graph: gtsam.NonlinearFactorGraph, ordering: gtsam.Ordering | OrderingKind = "colamd", term: str = "graph"
    ):
        """Choose the elimination ordering once.

        Args:
            graph: Native and custom factors.
            ordering: An ordering, or how to compute one: 'colamd', 'metis', or 'natural' (key order).
            term: Name of the energy in summaries.
        """
        self.graph, self.term = graph, term
        if ordering == "colamd":
            ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
        elif ordering == "metis":
            ordering = gtsam.Ordering.MetisNonlinearFactorGraph(graph)
        elif ordering == "natural":
            ordering = _natural(graph)
        self.ordering = ordering

    def energies(self, state: gtsam.Values) -> dict[str, float]:
        """Return the graph's error."""
        return {self.term: float(self.graph.error(state))}

    def retract(self, state: gtsam.Values, delta: gtsam.VectorValues) -> gtsam.Values:
        """Return ``state`` moved by ``delta``."""
        return state.retract(delta)

    def linearize(self, state: gtsam.Values) -> GraphLinearization:
        """Linearise every factor; raises SolverError naming the factor that is not finite."""
        gaussian = self.graph.linearize(state)
        gradient = gaussian.gradientAtZero()
        keys = [key for key in list(state.keys()) if gradient.exists(key)]
        vector = gradient.vector(keys)
        if not np.isfinite(vector).all():
            raise SolverError(self._blame(state))
        return GraphLinearization(gaussian, self.ordering, keys, np.asarray(vector))

    def _blame(self, state: gtsam.Values) -> str:
        for i in range(self.graph.size()):
            factor = self.graph.at(i)
            if factor is not None and not math.isfinite(factor.error(state)):
                names = ", ".join(str(decode(key)) for key in factor.keys())
                return f"{self.term}: factor {i} on {names} is not finite. Check the values it measures."
        return f"{self.term}: a Jacobian is not finite"

    def diagnose(self, state: gtsam.Values) -> str:
        """Name the variables whose information is zero and the factors that touch them."""
        gaussian = self.graph.linearize(state)
        names = []
        for key in list(state.keys()):
            touching = [i for i in range(self.graph.size()) if key in list(self.graph.at(i).keys())]
            single = gtsam.GaussianFactorGraph()
            for i in touching:
                single.push_back(gaussian.at(i))
            information = 0.0
            if touching:
                hessian, _ = single.hessian()
                information = float(np.abs(np.diag(hessian)).min())
            if information <= 1e-12:
                names.append(f"{decode(key)} (factors: {touching or 'none'})")
        if names:
            return "Not determined: " + "; ".join(names[:5]) + ". Give it observations or a prior."
        return "No single variable is undetermined: a gauge freedom remains; anchor a pose or the scale."


def _natural(graph: gtsam.NonlinearFactorGraph) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for key in sorted(graph.keyVector()):
        ordering.push_back(key)
    return ordering


class GraphLinearization:
    """A Gaussian factor graph and its gradient at one point."""

    def __init__(
        self, gaussian: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, keys: list[int], gradient: np.ndarray
    ):
        self.gaussian, self.ordering, self.keys, self.gradient = gaussian, ordering, keys, gradient

    @property
    def gradient_max(self) -> float:
        """Largest absolute entry of the gradient."""
        return float(np.abs(self.gradient).max(initial=0.0))

    def solve(self, damping: float) -> Step | None:
        """Return the step of ``H + damping I`` (GTSAM's default damping), or None when it is singular."""
        damped = gtsam.GaussianFactorGraph()
        damped.push_back(self.gaussian)
        zero = self.gaussian.gradientAtZero()
        root = math.sqrt(damping)
        for key in self.keys:
            n = len(zero.at(key))
            damped.push_back(gtsam.JacobianFactor(key, root * np.eye(n), np.zeros(n), gtsam.noiseModel.Unit.Create(n)))
        try:
            delta = damped.optimize(self.ordering)
        except RuntimeError:
            return None
        vector = np.asarray(delta.vector(self.keys))
        if not np.isfinite(vector).all():
            return None
        decrease = float(self.gaussian.error(_zero_like(zero)) - self.gaussian.error(delta))
        return Step(delta, float(np.linalg.norm(vector)), max(decrease, 0.0))


def _zero_like(values: gtsam.VectorValues) -> gtsam.VectorValues:
    return gtsam.VectorValues.Zero(values)
