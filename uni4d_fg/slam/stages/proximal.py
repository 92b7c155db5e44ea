r"""What keeps the paper's stage 3 near its start: a proximal term around the lifted points.

    E_prox = w sum_n w_n rho((log z_n - log D_n - s_t) / sigma)

Without a depth term the energy of stage 3 falls on and on as points shrink towards the camera: the motion terms are in
meters, and a smaller scene moves less. A descent that stops early never gets there; a solver that goes to the minimum
does. The term is the distance to the lift along the ray (N. Parikh and S. Boyd, "Proximal algorithms", 2014), in
units of the noise of the lift: ``sigma`` is how far the lifts of one static point scatter, in log depth. The kernel
is Huber's, as in the depth prior of energy 'map': squared within the noise, where a point pays next to nothing, and
linear beyond, so that a lift that is wrong does not hold its point at any price.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.stages import NonRigidConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import dynamic_depth_prior, log_depth
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.slam.stages.energy import Energy
from uni4d_fg.slam.stages.noise import robust_sigma
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras


def proximal_term(
    observations: Observations, rows: IntArray, cameras: Cameras, sigma: float, config: NonRigidConfig, energy: Energy
) -> FactorBatch:
    """Return the term of every observation with a depth.

    Args:
        observations: Of moving points.
        rows: (N,) row of each.
        cameras: Frozen poses and depth scales.
        sigma: Noise of the lift, in log depth.
        config: Weight of the whole term, and its kernel; an observation counts as in E_NR.
        energy: Weighs.
    """
    known = np.isfinite(observations.depth)
    seen = observations.select(known)
    weighed = energy.observed(
        sigma, seen.weight, config.depth_kernel, seen.frame, len(cameras.world_T_cam)
    ) | {"sigma": sigma}  # fmt: skip
    weighed["weight"] = config.proximal_weight * np.asarray(weighed["weight"])
    return dynamic_depth_prior(
        rows[known], depth=seen.depth, world_T_cam=cameras.world_T_cam[seen.frame],
        log_scale=cameras.log_scale[seen.frame], **weighed,
    )  # fmt: skip


def lift_noise(static: Observations, landmarks: FloatArray, cameras: Cameras) -> float:
    """Return how far the lifts of one static point scatter, as the robust standard deviation of log depth.

    Args:
        static: N observations.
        landmarks: (N, 3) the landmark of each.
        cameras: Poses and depth scales.

    Returns:
        NaN without any depth.
    """
    z = world_to_camera(cameras.world_T_cam[static.frame], landmarks)[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        departure = log_depth(z) - np.log(static.depth) - cameras.log_scale[static.frame]
    return robust_sigma(departure[np.isfinite(departure)])
