"""Whether fitted distortion can be that of a lens, and whether it is so weak that more must speak for it."""

from __future__ import annotations

from enum import Enum

import numpy as np

from uni4d_fg.config.camera import CameraConfig
from uni4d_fg.geometry.lens import Lens

_FAR = 3.0
"""A parameter that is farther from zero than so many sigmas of its prior is no lens: it makes up for what moves."""


class Strength(Enum):
    """Of distortion that was fitted."""

    NO_LENS = "no lens"
    """It hardly moves a pixel, or farther than lenses do."""
    WEAK = "weak"
    """Errors of a tracker, or of a depth cue, mimic as much."""
    SURE = "sure"


def strength_of(lens: Lens, displacement_px: float, image_size: tuple[int, int], settings: CameraConfig) -> Strength:
    """Return how strong a lens is.

    Args:
        lens: What was fitted.
        displacement_px: How far it moves a pixel of the image at most.
        image_size: (height, width), px.
        settings: Limits.
    """
    if max(map(abs, lens.parameters), default=0.0) > _FAR * settings.parameter_prior_sigma:
        return Strength.NO_LENS
    if not settings.min_displacement_px < displacement_px < np.inf:
        return Strength.NO_LENS
    return Strength.WEAK if displacement_px < settings.sure_displacement * max(image_size) else Strength.SURE
