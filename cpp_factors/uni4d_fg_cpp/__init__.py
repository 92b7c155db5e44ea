"""C++ factors and linear solvers for uni4d_fg; NumPy arrays in, NumPy arrays out.

Everything is in the compiled module ``_core``: ``<family>_residual`` and ``<family>_linearize`` for every factor
family, ``whiten`` and ``robust_energy`` for noise and robust kernels, and the systems that solve the stages. Arrays
are float64 (row numbers int64) and C-contiguous; a ValueError or TypeError names the argument that is not.
"""

from uni4d_fg_cpp import _core
from uni4d_fg_cpp._core import ABI, LandmarkSystem, PairSystem, TrajectorySystem, robust_energy, whiten

__all__ = ["ABI", "LandmarkSystem", "PairSystem", "TrajectorySystem", "_core", "robust_energy", "whiten"]
