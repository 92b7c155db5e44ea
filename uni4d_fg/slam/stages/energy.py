r"""The choice of energy: one object that gives sigma, weight and kernel of every term.

``MAP``     E = sum_n w_n rho(|r_n| / sigma): a maximum a posteriori estimate with noise in the residual's unit.
``paper``   E = sum over terms of w |r_n|: Uni4D's unsquared norms with its term weights. ``mean`` divides an
            observation by what its cell (frame, or frame pair) holds and by the number of cells, and a link by the
            number of links, as the authors' program does; ``sum`` divides nothing, as the paper's text has it. In
            stage 1 a quadratic kernel gives w |r_n|^2 / 2, half of what the text has there (equation 4).

Unsquared norms are smoothed at zero for solvers that need a second derivative; ``Problem.energies(state, exact=True)``
scores them without. The configuration refuses kernels of the other energy everywhere else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.config.solver import KernelConfig
from uni4d_fg.factors.kernels import Kernel

Normalization = Literal["mean", "sum"]


class Energy(Protocol):
    """What a stage asks when it adds a term; the answers are keyword arguments of a factor type."""

    @property
    def is_likelihood(self) -> bool:
        """Whether sigmas are standard deviations: noise can be measured, and covariances mean something."""
        ...

    def observed(
        self, sigma: float, weight: FloatArray, kernel: KernelConfig, cell: IntArray, num_cells: int
    ) -> dict[str, Any]:
        """Weigh N observations.

        Args:
            sigma: Standard deviation, in the residual's unit.
            weight: (N,) trust in each.
            kernel: The term's kernel.
            cell: (N,) frame or frame pair of each.
            num_cells: Number of frames or frame pairs.
        """
        ...

    def linked(self, sigma: float, weight: float, kernel: KernelConfig, count: int) -> dict[str, Any]:
        """Weigh ``count`` regularizing factors of a term with one weight."""
        ...


@dataclass(frozen=True)
class MapEnergy:
    """Squared residuals with robust kernels and calibrated noise."""

    is_likelihood: bool = True

    def observed(
        self, sigma: float, weight: FloatArray, kernel: KernelConfig, cell: IntArray, num_cells: int
    ) -> dict[str, Any]:
        """Return the sigma, the weights and the kernel as they are."""
        return {"sigma": sigma, "weight": weight, "kernel": kernel_of(kernel)}

    def linked(self, sigma: float, weight: float, kernel: KernelConfig, count: int) -> dict[str, Any]:
        """Return the sigma, the weight and the kernel as they are."""
        return {"sigma": sigma, "weight": weight, "kernel": kernel_of(kernel)}


@dataclass(frozen=True)
class PaperEnergy:
    """Unsquared norms with the paper's weights."""

    normalization: Normalization = "mean"
    is_likelihood: bool = False

    def observed(
        self, sigma: float, weight: FloatArray, kernel: KernelConfig, cell: IntArray, num_cells: int
    ) -> dict[str, Any]:
        """Return the weights ``w / (cells sum of w in the cell)``, or ``w``; sigmas do not count."""
        if self.normalization == "mean":
            total = np.bincount(cell, weight, num_cells)
            weight = weight / (num_cells * np.maximum(total[cell], 1e-16))
        return {"weight": weight, "kernel": kernel_of(kernel)}

    def linked(self, sigma: float, weight: float, kernel: KernelConfig, count: int) -> dict[str, Any]:
        """Return the weight, divided by the number of links for 'mean'; sigmas do not count."""
        mean = self.normalization == "mean"
        return {"weight": weight / max(count, 1) if mean else weight, "kernel": kernel_of(kernel)}


MAP = MapEnergy()


def energy_of(config: Config) -> Energy:
    """Return the energy that a configuration chooses."""
    return MAP if config.energy == "map" else PaperEnergy(config.normalization)


def kernel_of(config: KernelConfig) -> Kernel:
    """Return the kernel a configuration section describes."""
    return Kernel(config.kind, config.threshold)
