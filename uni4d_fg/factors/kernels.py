r"""Robust kernels rho(s) on the whitened residual norm s >= 0.

With e the noise in whitened units, a term costs ``rho(s)`` instead of ``s^2/2``; iteratively reweighted
least squares uses the weight ``w(s) = rho'(s) / s`` (Holland and Welsch 1977; the same weights as GTSAM's
``noiseModel.mEstimator``). c is the threshold.

    quadratic      s^2 / 2                         w = 1
    huber          s^2/2 | c s - c^2/2             w = min(1, c / s)
    pseudo_huber   c^2 (sqrt(1 + (s/c)^2) - 1)     w = 1 / sqrt(1 + (s/c)^2)
    cauchy         c^2/2 log(1 + (s/c)^2)          w = 1 / (1 + (s/c)^2)
    norm           sqrt(s^2 + c^2) - c             w = 1 / sqrt(s^2 + c^2)

``norm`` is the unsquared Euclidean norm smoothed at zero: slope 1 far away, so that a term's weight is the
weight of the paper's unsquared norm. It tends to ``s`` as c tends to 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Literal, get_args

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.errors import SolverError

KernelKind = Literal["quadratic", "huber", "pseudo_huber", "cauchy", "norm"]


@dataclass(frozen=True)
class Kernel:
    """A robust kernel and its threshold c (whitened units).

    Raises:
        SolverError: On construction, if there is no such kernel, or the threshold is not finite and positive.
    """

    kind: KernelKind = "quadratic"
    threshold: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(KernelKind):
            raise SolverError(f"there is no kernel {self.kind!r}; choose one of {', '.join(get_args(KernelKind))}")
        if not (isinstance(self.threshold, Real) and 0.0 < self.threshold < np.inf):
            raise SolverError(
                f"kernel '{self.kind}': the threshold must be finite and positive, got {self.threshold!r}"
            )

    def rho(self, squared: Array) -> Array:
        """Evaluate the kernel at squared norms s^2, NumPy or torch; same shape, with a finite gradient at zero."""
        c = self.threshold
        if self.kind == "quadratic":
            return 0.5 * squared
        xp = namespace(squared)
        if self.kind == "huber":
            inside = squared <= c * c
            # A square root at zero has an infinite slope, which where() would multiply by zero.
            outside = c * xp.sqrt(xp.where(inside, c * c + 0.0 * squared, squared)) - 0.5 * c * c
            return xp.where(inside, 0.5 * squared, outside)
        x = squared / (c * c)
        if self.kind == "cauchy":
            return 0.5 * c * c * xp.log1p(x)
        root = x / (xp.sqrt(1.0 + x) + 1.0)  # sqrt(1 + x) - 1 without cancellation
        return (c * c if self.kind == "pseudo_huber" else c) * root

    def exact(self, squared: Array) -> Array:
        """Evaluate the kernel that is meant: 'norm' is the Euclidean norm itself, without a solver's smoothing."""
        return namespace(squared).sqrt(squared) if self.kind == "norm" else self.rho(squared)

    def weight(self, squared: FloatArray) -> FloatArray:
        """Evaluate the weight rho'(s)/s at squared norms s^2; same shape, finite at zero."""
        c = self.threshold
        result: FloatArray
        if self.kind == "quadratic":
            result = np.ones_like(squared)
        elif self.kind == "huber":
            result = c / np.sqrt(np.maximum(squared, c * c))
        elif self.kind == "pseudo_huber":
            result = 1.0 / np.sqrt(1.0 + squared / (c * c))
        elif self.kind == "cauchy":
            result = 1.0 / (1.0 + squared / (c * c))
        else:
            result = 1.0 / np.sqrt(squared + c * c)
        return result

    def falloff(self, squared: FloatArray) -> FloatArray:
        """Return how fast the weight falls along the residual, ``-s w'(s) / w(s)``, at most 1; same shape.

        The curvature of the kernel is ``w`` across the residual and ``w (1 - falloff)`` along it, zero where the true
        one would be negative (Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 4.3).
        """
        result: FloatArray = np.minimum(1.0 - self.slope(squared, 1) / self.weight(squared), 1.0)
        return result

    def slope(self, squared: FloatArray, dim: int) -> FloatArray:
        """Return the slope of ``w(s) r`` with respect to a residual r of ``dim`` entries, averaged over directions.

        ``w + s w'(s) / dim``; same shape as ``squared``. It is what curvature a robust term truly has (Huber 1981),
        where the weight is what reweighted least squares uses.
        """
        c, w = self.threshold, self.weight(squared)
        result: FloatArray
        if self.kind == "quadratic":
            result = w
        elif self.kind == "huber":
            result = np.where(squared <= c * c, 1.0, w * (1.0 - 1.0 / dim))
        elif self.kind == "pseudo_huber":
            result = w - squared / (c * c) * w**3 / dim
        elif self.kind == "cauchy":
            result = w - 2.0 * squared / (c * c) * w**2 / dim
        else:
            result = w - squared * w**3 / dim
        return result

    def square_root(self, squared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the scale a(s) for which |a r|^2 / 2 = rho(s), and (da/ds) / s; both finite at zero.

        A residual scaled by a(s) carries the kernel inside plain least squares: this is how a factor that
        stacks several residuals is made robust row by row.
        """
        safe = np.maximum(squared, 1e-24)
        rho = self.rho(safe)
        a = np.sqrt(2.0 * rho / safe)
        # a^2 = 2 rho / s^2  =>  a a' = rho'/s^2 - 2 rho/s^3, so a'/s = (w - a^2) / (a s^2)
        slope = np.where(squared < 1e-12, 0.0, (self.weight(safe) - a * a) / (a * safe))
        return a, slope
