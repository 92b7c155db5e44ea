"""What a window knows of its cameras, with its landmarks eliminated; see :mod:`uni4d_fg.slam.windows.join`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.se3 import inverse_right_jacobian, se3_log
from uni4d_fg.optim.cluster_robust import Spread
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.plan import Window

FRAME = 7
"""Columns per frame: twist, log-scale."""
SHARED = 4
"""Columns after those of all frames: the intrinsics. Those of added variables follow."""


@dataclass(frozen=True)
class WindowInformation:
    """What one window knows: columns are 7 per frame (twist, log-scale) and 4 for the intrinsics."""

    window: Window
    point: Cameras
    """Linearization point, in the axes of the window's first camera."""
    hessian: FloatArray
    """(n, n); zero in the columns of the first pose."""
    gradient: FloatArray
    """(n,)."""
    curvature: FloatArray
    """(n, n) the Hessian with the mean slopes of the kernels, for covariances."""
    spread: Spread | None
    """Of the gradient; None where errors count as independent."""

    def columns(self, num_frames: int) -> IntArray:
        """Return the place (n,) of its columns among those of all frames."""
        frames = np.arange(FRAME * self.window.start, FRAME * self.window.stop)
        return np.concatenate([frames, FRAME * num_frames + np.arange(SHARED)])

    def difference(self, cameras: Cameras) -> tuple[FloatArray, FloatArray]:
        """Return d (n,) and its Jacobian (n, n) with respect to the shared cameras' tangents."""
        here, count = cameras.part(self.window.start, self.window.stop), len(self.window)
        twist = se3_log(se3.inverse(self.point.world_T_cam) @ here.world_T_cam)
        inverse_jacobian = inverse_right_jacobian(twist)
        d, jacobian = np.zeros(FRAME * count + SHARED), np.eye(FRAME * count + SHARED)
        for i in range(count):
            own = slice(FRAME * i, FRAME * i + 6)
            d[own] = twist[i]
            jacobian[own, own] = inverse_jacobian[i] if i else 0.0
            if i:
                back = se3.adjoint(se3.inverse(here.world_T_cam[i]))
                jacobian[own, :6] = -inverse_jacobian[i] @ back
        d[6 : FRAME * count : FRAME] = here.log_scale - self.point.log_scale
        d[-SHARED:] = here.intrinsics - self.point.intrinsics
        return d, jacobian
