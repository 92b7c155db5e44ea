"""The language: variable types, factor types, one file per energy term, robust kernels, batches and states.

Residuals are pure and batched, and take NumPy arrays or torch tensors alike, so that Levenberg-Marquardt, the Adam
baseline and the exact energy evaluate one and the same function.
"""

from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.factor_type import FactorType, factor, factor_types
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable import VariableType

__all__ = [
    "FactorBatch",
    "FactorType",
    "Kernel",
    "Slot",
    "State",
    "VariableType",
    "factor",
    "factor_types",
]
