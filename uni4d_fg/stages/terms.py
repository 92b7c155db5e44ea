"""Terms that several stages share."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.stages import CameraMotionConfig
from uni4d_fg.factors.batch import FactorBatch, Slot
from uni4d_fg.factors.camera_motion import CAMERA_ROTATION, CAMERA_TRANSLATION
from uni4d_fg.factors.kernels import Kernel
from uni4d_fg.factors.priors import ASPECT_PRIOR, INTRINSICS_PRIOR


def camera_motion_terms(frames: IntArray, config: CameraMotionConfig, unsquared: bool) -> list[FactorBatch]:
    """Return E_rot and E_trans over consecutive ``frames`` (W,); empty when switched off or W < 3."""
    if len(frames) < 3:
        return []
    slots = tuple(Slot("pose", frames[i : len(frames) - 2 + i]) for i in range(3))
    count = len(frames) - 2
    kernel = Kernel("norm", config.norm_threshold) if unsquared else Kernel("quadratic")
    terms = (
        (CAMERA_ROTATION, config.rotation_weight, config.rotation_floor_rad),
        (CAMERA_TRANSLATION, config.translation_weight, config.translation_floor_m),
    )
    return [
        FactorBatch.create(
            family,
            slots,
            {"floor": np.full(count, floor)},
            weight=weight / count if unsquared else weight,
            kernel=kernel,
        )
        for family, weight, floor in terms
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
    slots = (Slot("intrinsics", np.zeros(1, dtype=np.int64)),)
    sigma = focal_fraction * np.array([[fx, fy, fx, fy]])
    ratio = np.log(intrinsics[:, 0] / intrinsics[:, 1])
    return [
        FactorBatch.create(INTRINSICS_PRIOR, slots, {"measured": intrinsics}, sigma=sigma),
        FactorBatch.create(ASPECT_PRIOR, slots, {"measured": ratio}, sigma=aspect_sigma),
    ]
