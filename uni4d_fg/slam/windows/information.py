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
class Uncertainty:
    """What the covariances of a window's cameras are made of, besides its information."""

    curvature: FloatArray
    """(n, n) the Hessian with the mean slopes of the kernels."""
    spread: Spread | None
    """Of the gradient; None where errors count as independent."""


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
    uncertainty: Uncertainty | None = None
    """None where no covariances are asked for: it takes as long as the rest, and is twice as large."""

    def columns(self, num_frames: int) -> IntArray:
        """Return the place (n,) of its columns among those of all frames."""
        frames = np.arange(FRAME * self.window.start, FRAME * self.window.stop)
        return np.concatenate([frames, FRAME * num_frames + np.arange(SHARED)])

    def difference(self, cameras: Cameras) -> tuple[FloatArray, WindowJacobian]:
        """Return d (n,) and its Jacobian with respect to the shared cameras' tangents."""
        here, count = cameras.part(self.window.start, self.window.stop), len(self.window)
        twist = se3_log(se3.inverse(self.point.world_T_cam) @ here.world_T_cam)
        own = inverse_right_jacobian(twist)
        first = -own @ se3.adjoint(se3.inverse(here.world_T_cam))
        own[0], first[0] = 0.0, 0.0
        d = np.zeros(FRAME * count + SHARED)
        frames = d[: FRAME * count].reshape(count, FRAME)
        frames[:, :6], frames[:, 6] = twist, here.log_scale - self.point.log_scale
        d[-SHARED:] = here.intrinsics - self.point.intrinsics
        return d, WindowJacobian(own, first)


@dataclass(frozen=True)
class WindowJacobian:
    """Jacobian J (n, n) of a window's difference.

    A camera is seen from the window's first: its twist moves with its own tangent and with that of the first, with no
    other. Log-scales and intrinsics move with themselves. Products by these blocks take less time than dense ones.
    """

    own: FloatArray
    """(F, 6, 6) with respect to a camera's own tangent."""
    first: FloatArray
    """(F, 6, 6) with respect to that of the first camera."""

    def left_product(self, matrix: FloatArray) -> FloatArray:
        """Return ``matrix @ J`` for a matrix (m, n)."""
        rows, count = len(matrix), len(self.own)
        product = np.array(matrix)
        twists = np.ascontiguousarray(matrix[:, : FRAME * count].reshape(rows, count, FRAME)[:, :, :6])
        frames = product[:, : FRAME * count].reshape(rows, count, FRAME)
        frames[:, :, :6] = (twists.transpose(1, 0, 2) @ self.own).transpose(1, 0, 2)
        frames[:, 0, :6] += twists.reshape(rows, 6 * count) @ self.first.reshape(6 * count, 6)
        return product

    def congruent(self, matrix: FloatArray) -> FloatArray:
        """Return ``J^T @ matrix @ J`` for a symmetric matrix (n, n)."""
        return self.left_product(np.ascontiguousarray(self.left_product(matrix).T))
