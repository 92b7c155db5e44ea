"""Robust kernels on NumPy arrays and torch tensors alike, with finite gradients at zero."""

from __future__ import annotations

from uni4d_fg.arrays import Array, namespace
from uni4d_fg.factors.kernels import Kernel


def rho(kernel: Kernel, squared: Array) -> Array:
    """Evaluate :meth:`uni4d_fg.factors.kernels.Kernel.rho` at squared norms s^2 of any shape."""
    xp = namespace(squared)
    c = kernel.threshold
    if kernel.kind == "quadratic":
        return 0.5 * squared
    if kernel.kind == "huber":
        inside = squared <= c * c
        # A square root at zero has an infinite slope, which where() would multiply by zero.
        outside = c * xp.sqrt(xp.where(inside, c * c + 0.0 * squared, squared)) - 0.5 * c * c
        return xp.where(inside, 0.5 * squared, outside)
    x = squared / (c * c)
    if kernel.kind == "cauchy":
        return 0.5 * c * c * xp.log1p(x)
    root = x / (xp.sqrt(1.0 + x) + 1.0)  # sqrt(1 + x) - 1 without cancellation
    return c * c * root if kernel.kind == "pseudo_huber" else c * root
