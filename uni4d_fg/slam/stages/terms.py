"""Terms that several stages share."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.solver import KernelConfig
from uni4d_fg.config.stages import CameraMotionConfig
from uni4d_fg.factors.batch import FactorBatch
from uni4d_fg.factors.camera_motion import camera_rotation, camera_translation, relative_camera_translation
from uni4d_fg.factors.priors import aspect_prior, intrinsics_prior
from uni4d_fg.slam.stages.energy import Energy


def camera_motion_terms(frames: IntArray, config: CameraMotionConfig, energy: Energy) -> list[FactorBatch]:
    """Return E_rot and E_trans over consecutive ``frames`` (W,); empty when switched off or W < 3."""
    count = len(frames) - 2
    if count < 1:
        return []
    kernel = KernelConfig(kind="quadratic")
    if not energy.is_likelihood:
        kernel = KernelConfig(kind="norm", threshold=config.norm_threshold)
    translation = camera_translation if config.translation_axes == "world" else relative_camera_translation
    terms = (
        (camera_rotation, config.rotation_weight, config.rotation_floor_rad),
        (translation, config.translation_weight, config.translation_floor_m),
    )
    triples = [frames[i : count + i] for i in range(3)]
    return [
        factor(*triples, floor=np.full(count, floor), **energy.linked(1.0, weight, kernel, count))
        for factor, weight, floor in terms
        if weight > 0
    ]


def intrinsics_priors(intrinsics: FloatArray, focal_fraction: float, aspect_sigma: float) -> list[FactorBatch]:
    """Return the priors on the intrinsics (1, 4): about their value, and on the shape of a pixel.

    Args:
        intrinsics: (1, 4) the sequence's own.
        focal_fraction: Sigma of every entry as a part of the focal lengths.
        aspect_sigma: Sigma of log(fx / fy).
    """
    fx, fy = intrinsics[0, 0], intrinsics[0, 1]
    sigma = focal_fraction * np.array([[fx, fy, fx, fy]])
    ratio = np.log(intrinsics[:, 0] / intrinsics[:, 1])
    return [intrinsics_prior(0, measured=intrinsics, sigma=sigma), aspect_prior(0, measured=ratio, sigma=aspect_sigma)]
