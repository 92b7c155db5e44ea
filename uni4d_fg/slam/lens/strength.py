"""Whether fitted distortion can be that of a lens, and whether it is so weak that more must speak for it."""

from __future__ import annotations

from enum import Enum

import numpy as np

from uni4d_fg.config.camera import CameraConfig
from uni4d_fg.geometry.lens import Lens

_FAR = 3.0
"""A parameter that is farther from zero than so many sigmas of its prior is that of no lens."""


class Strength(Enum):
    """Of distortion that was fitted."""

    NO_LENS = "no lens"
    """It hardly moves a pixel."""
    BEYOND = "beyond lenses"
    """It moves pixels farther than lenses do: it makes up for something else."""
    WEAK = "weak"
    """Errors of a tracker, or of a depth cue, mimic as much."""
    SURE = "sure"

    @property
    def is_lens(self) -> bool:
        """Whether a lens may do this."""
        return self in (Strength.WEAK, Strength.SURE)


def strength_of(lens: Lens, displacement_px: float, image_size: tuple[int, int], settings: CameraConfig) -> Strength:
    """Return how strong a lens is.

    Args:
        lens: What was fitted.
        displacement_px: How far it moves a pixel of the image at most.
        image_size: (height, width), px.
        settings: Limits.
    """
    if displacement_px <= settings.min_displacement_px:
        return Strength.NO_LENS
    part = displacement_px / max(image_size)
    is_far = max(map(abs, lens.parameters)) > _FAR * settings.parameter_prior_sigma
    is_pincushion = lens.parameters[0] > 0.0
    if is_far or not np.isfinite(part) or (is_pincushion and part > settings.max_pincushion):
        return Strength.BEYOND
    return Strength.WEAK if part < settings.sure_displacement else Strength.SURE
