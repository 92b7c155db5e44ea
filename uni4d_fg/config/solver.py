"""Configuration of the Levenberg-Marquardt driver and of robust kernels."""

from __future__ import annotations

from typing import Literal

from uni4d_fg.config.base import Section, setting

NEAR_DAMPING = 1e-8
"""First damping of a solve that starts near its minimum: more holds focal lengths, along which the energy is nearly
flat, and the solve ends before they have moved."""


class SolverConfig(Section):
    """Options of one solve."""

    optimizer: Literal["levenberg_marquardt", "gtsam_levenberg_marquardt", "gtsam_dogleg"] = setting(
        "levenberg_marquardt",
        "What minimizes: this package's loop on the chosen backend, or one of GTSAM's optimizers on the stage's "
        "factor graph, which are slow: for small problems and for comparison.",
    )
    max_iterations: int = setting(50, "Largest number of linearizations.", ge=1, basic=True)
    relative_decrease: float = setting(
        1e-5, "Stop when an accepted step lowers the energy by less than this part.", gt=0, lt=1
    )
    early_relative_decrease: float | None = setting(
        None,
        "The same for all rounds of a stage but its last (annealing, warm-up), and for the first of two solves of the "
        "structure: they only lead there. Null takes "
        "relative_decrease.",
        gt=0,
        lt=1,
    )
    gradient_tolerance: float = setting(1e-10, "Stop when the scaled gradient's largest entry is below this.", ge=0)
    step_tolerance: float = setting(1e-9, "Stop when the step's norm is below this.", ge=0)
    initial_damping: float = setting(1e-4, "First damping, relative to the Hessian's diagonal.", gt=0)
    max_damping: float = setting(1e10, "Damping above which the solve stops with 'damping limit'.", gt=0)
    min_diagonal: float = setting(1e-6, "Floor of the Hessian's diagonal used for damping.", gt=0)
    max_diagonal: float = setting(1e32, "Ceiling of the Hessian's diagonal used for damping.", gt=0)
    landmark_steps: int = setting(
        0,
        "Landmarks that are eliminated only: after each step every landmark moves on alone by up to this many, while "
        "the other variables rest. Pays where little couples them; GTSAM's own optimizers do not.",
        ge=0,
    )
    kernel_curvature: float = setting(
        0.0,
        "Moving points only: part of the robust kernels' curvature that the steps account for once one has lowered "
        "the energy by less than 0.2 %; 0 reweights only, which ends slowly.",
        ge=0,
        lt=1,
    )
    cg_tolerance: float = setting(0.03, "Relative residual at which an inexact inner solve stops.", gt=0, lt=1)
    cg_max_iterations: int = setting(200, "Largest number of inner conjugate-gradient steps.", ge=1)


class KernelConfig(Section):
    """A robust kernel on the whitened residual norm s."""

    kind: Literal["quadratic", "huber", "pseudo_huber", "cauchy", "norm"] = setting(
        "huber",
        "rho(s): 'quadratic' s^2/2; 'huber', 'pseudo_huber', 'cauchy' with threshold; "
        "'norm' sqrt(s^2 + threshold^2), the smooth form of the unsquared norm.",
    )
    threshold: float = setting(
        1.345, "Threshold in whitened units (for 'norm': smoothing in the residual's unit).", gt=0
    )


class NativeKernelConfig(KernelConfig):
    """A robust kernel that GTSAM's own factors take."""

    kind: Literal["quadratic", "huber", "cauchy"] = setting(
        "huber", "rho(s): 'quadratic' s^2/2; 'huber' and 'cauchy' with threshold."
    )
