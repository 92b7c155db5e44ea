"""Where the pixels of one camera are seen by another one, by their depth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.geometry.camera import intrinsics_matrix


class PixelTransfer(NamedTuple):
    """Pixel (x, y, 1) of a camera at inverse depth rho is at ``turn x + rho shift`` in another one.

    The last entry of that is the depth in the other camera over the one in the first.
    """

    turn: FloatArray
    """(3, 3)."""
    shift: FloatArray
    """(3,)."""


def pixel_transfer(intrinsics: FloatArray, other_intrinsics: FloatArray, other_T_cam: FloatArray) -> PixelTransfer:
    """Return where another camera sees the pixels of one.

    Args:
        intrinsics: (4,) fx, fy, cx, cy, px.
        other_intrinsics: (4,) those of the other camera.
        other_T_cam: (4, 4) pose of the camera in the other one's frame.
    """
    to_pixels = intrinsics_matrix(other_intrinsics)
    turn: FloatArray = to_pixels @ other_T_cam[:3, :3] @ np.linalg.inv(intrinsics_matrix(intrinsics))
    return PixelTransfer(turn, to_pixels @ other_T_cam[:3, 3])
