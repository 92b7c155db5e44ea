"""C++ factors and linear solvers for uni4d_fg; NumPy arrays in, NumPy arrays out.

Everything is in the compiled module ``_core``: ``factor_types`` lists the factor types that have a kernel,
``residual`` and ``linearize`` run one by its name, ``whiten`` and ``robust_energy`` apply noise and robust kernels,
the systems solve the stages, ``register_patches`` finds patches in an image, ``plane_sweep`` matches views,
``compare_frames`` compares their depth, ``guided_median`` brings its edges to those of the image and
``upsample_guided`` to its size, ``moved_evidence`` says what has moved between frames, and ``ray_equations``,
``refine_points``, ``ray_angles`` and ``reprojection_errors`` find points from rays and judge them. Arrays are float64
(row numbers int64, maps float32, images uint8) and C-contiguous; a ValueError or TypeError names the argument that is
not.
"""

from uni4d_fg_cpp import _core
from uni4d_fg_cpp._core import (
    ABI,
    LandmarkSystem,
    PairSystem,
    TrajectorySystem,
    compare_frames,
    factor_types,
    guided_median,
    linearize,
    moved_evidence,
    plane_sweep,
    ray_angles,
    ray_equations,
    refine_points,
    register_patches,
    reprojection_errors,
    residual,
    robust_energy,
    upsample_guided,
    whiten,
)

__all__ = [
    "ABI",
    "LandmarkSystem",
    "PairSystem",
    "TrajectorySystem",
    "_core",
    "compare_frames",
    "factor_types",
    "guided_median",
    "linearize",
    "moved_evidence",
    "plane_sweep",
    "ray_angles",
    "ray_equations",
    "refine_points",
    "register_patches",
    "reprojection_errors",
    "residual",
    "robust_energy",
    "upsample_guided",
    "whiten",
]
