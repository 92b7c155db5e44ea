"""A lens from epipolar geometry alone, before any camera is known.

Through a lens that bends the image, tracks do not meet the epipolar lines of a pinhole: the geometry that fits most of
them between two frames, at any focal length, leaves a distance that is least where the right distortion is undone. So a
few lenses are tried, one after another, and the focal length is what the pairs tell at the best one. A camera that pans
is told best; it is the one whose scene a wrong lens bends beyond what can be refined.

Source: Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion" (CVPR 2001), for the
idea; the parameter is tried here instead of solved for.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.structure.epipolar import epipolar_geometry
from uni4d_fg.cues.structure.selection import spread_tracks
from uni4d_fg.cues.structure.self_calibration import focal_of_pairs, least_of
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

_K1 = np.linspace(-0.4, 0.15, 12)
"""That are tried, at a focal length of the longer side of the image."""
_CLEAR = 0.95
"""Part of what a pinhole leaves that the best lens leaves at most: between others that leave more."""


def lens_of_pairs(
    observations: Observations,
    num_frames: int,
    image_size: tuple[int, int],
    intrinsics: FloatArray,
    config: GeometricDepthConfig,
) -> CameraModel | None:
    """Return the lens that pairs of frames tell, with the focal length that goes with it; None if they tell none.

    Args:
        observations: Of static tracks, as the images show them.
        num_frames: T.
        image_size: (height, width), px.
        intrinsics: (4,) px, of which the principal point serves, and the focal lengths where pairs tell none.
        config: How many tracks are taken, and how pairs are compared.
    """
    longer = float(max(image_size))
    unit = np.array([longer, longer, *intrinsics[2:]])
    used = observations.select(spread_tracks(observations, image_size, config.max_tracks))
    found = [
        epipolar_geometry(_through(unit, k1).ideal_observations(used), num_frames, image_size, config) for k1 in _K1
    ]
    left = np.array([geometry.left_px for geometry in found])
    best = int(left.argmin())
    if best in (0, len(_K1) - 1) or not left[best] <= _CLEAR * left[np.abs(_K1).argmin()]:
        return None
    told = focal_of_pairs(found[best].fundamental, image_size, intrinsics[2:])
    focal = told.focal if told is not None and told.is_agreed else float(np.mean(intrinsics[:2]))
    # Coordinates are parts of the focal length, so that k1 of what bends the same pixels grows with its square.
    ratio = focal / longer
    return _through(unit * np.array([ratio, ratio, 1.0, 1.0]), least_of(_K1, left) * ratio**2)


def _through(intrinsics: FloatArray, k1: float) -> CameraModel:
    return CameraModel(intrinsics, Lens("SIMPLE_RADIAL", (k1,)))
