"""C++ factors and linear solvers for uni4d_fg; NumPy arrays in, NumPy arrays out."""

from uni4d_fg_cpp import _core
from uni4d_fg_cpp._core import ABI

__all__ = ["ABI", "_core"]
