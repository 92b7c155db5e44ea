"""One file per energy term: its formula, its residual on arrays, its analytic Jacobian.

Residual functions are pure and batched, and accept NumPy arrays or torch tensors alike, so that
Levenberg-Marquardt, the Adam baseline and the exact scorer evaluate one and the same function.
"""

from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.family import FactorFamily
from uni4d_fg.factors.kernels import Kernel

__all__ = ["FactorBatch", "FactorFamily", "Kernel", "Slot"]
