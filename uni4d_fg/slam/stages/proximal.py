r"""What keeps the paper's stage 3 near its start: a proximal term around the lifted points.

    E_prox = w sum_n w_n rho((log z_n - log D_n - s_t) / sigma)

Without a depth term the energy of stage 3 falls on and on as points shrink towards the camera: the motion terms are in
meters, and a smaller scene moves less. A descent that stops early never gets there; a solver that goes to the minimum
does. The term is the distance to the lift along the ray (N. Parikh and S. Boyd, "Proximal algorithms", 2014), in
units of the noise of the lift. Static points tell both: ``s_t`` is by how much the lifts of frame t are too near, and
``sigma`` how far the lifts of one point then scatter, in log depth. Without ``s_t`` the term would hold what all points
of a frame have in common, the flicker of the cue, against the motion terms. The kernel is Huber's, as in the depth
prior of energy 'map': squared within the noise, where a point pays next to nothing, and linear beyond, so that a lift
that is wrong does not hold its point at any price.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.stages import NonRigidConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.depth_prior import dynamic_depth_prior, log_depth
from uni4d_fg.geometry.camera import seen_from
from uni4d_fg.robust import robust_sigma
from uni4d_fg.slam.stages.energy import Energy
from uni4d_fg.slam.stages.lifting import frame_log_scales
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras


@dataclass(frozen=True)
class LiftNoise:
    """What static points say of the depths that points are lifted with."""

    log_scale: FloatArray
    """(T,) log z - log cue of a frame; its median."""
    sigma: float
    """Robust standard deviation of log depth about it."""


def proximal_term(
    observations: Observations,
    rows: IntArray,
    cameras: Cameras,
    noise: LiftNoise,
    config: NonRigidConfig,
    energy: Energy,
) -> FactorBatch:
    """Return the term of every observation with a depth.

    Args:
        observations: Of moving points.
        rows: (N,) row of each.
        cameras: Frozen poses.
        noise: Of the lift.
        config: Weight of the whole term, and its kernel; an observation counts as in E_NR.
        energy: Weighs.
    """
    known = np.isfinite(observations.depth)
    seen = observations.select(known)
    weighed = energy.observed(
        noise.sigma, seen.weight, config.depth_kernel, seen.frame, len(cameras.world_T_cam)
    ) | {"sigma": noise.sigma}  # fmt: skip
    weighed["weight"] = config.proximal_weight * np.asarray(weighed["weight"])
    return dynamic_depth_prior(
        rows[known], depth=seen.depth, world_T_cam=cameras.world_T_cam[seen.frame],
        log_scale=noise.log_scale[seen.frame], **weighed,
    )  # fmt: skip


def lift_noise(static: Observations, landmarks: FloatArray, cameras: Cameras) -> LiftNoise | None:
    """Measure the depths that points are lifted with at static points.

    Args:
        static: N observations.
        landmarks: (N, 3) the landmark of each.
        cameras: Poses. A frame without landmarks has the cue's own scale.

    Returns:
        None without any depth.
    """
    z = seen_from(cameras.world_T_cam, static.frame, landmarks)[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        measured = log_depth(z) - np.log(static.depth)
    known = np.isfinite(measured)
    if not known.any():
        return None
    log_scale = frame_log_scales(static, cameras.world_T_cam, landmarks, len(cameras.world_T_cam))
    return LiftNoise(log_scale, robust_sigma((measured - log_scale[static.frame])[known]))
