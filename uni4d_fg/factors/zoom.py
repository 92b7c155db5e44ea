r"""A camera that zooms: the focal length of each frame as a variable, and how smoothly it changes.

    reprojection  r = z_{k,t} - (e^{l_t} fx x g(z) + cx, e^{l_t} fy y g(z) + cy),   x = R_t^T (p_k - c_t)     [px]
    smoothness    r = l_{t+1} - l_t      [log focal length], 1-vector

l_t is the ``zoom`` of frame t, the logarithm of its focal length over the one in the ``intrinsics``; the principal
point and the shape of a pixel stay. g is 1/z in front of the camera (see :mod:`uni4d_fg.geometry.camera`). The second
is a random walk, whose sigma is what a frame may zoom.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import Array, FloatArray, namespace
from uni4d_fg.factors.factor_type import factor
from uni4d_fg.factors.static_reprojection import static_reprojection_jacobian
from uni4d_fg.factors.variable_types import INTRINSICS, LANDMARK, POSE, ZOOM
from uni4d_fg.geometry.camera import project, world_to_camera


def zoomed_intrinsics(intrinsics: Array, zoom: Array) -> Array:
    """Return intrinsics (N, 4) px of frames whose zoom is (N, 1)."""
    xp = namespace(intrinsics)
    return xp.concat((intrinsics[..., :2] * xp.exp(zoom), intrinsics[..., 2:]), axis=-1)


@factor(POSE, LANDMARK, INTRINSICS, ZOOM, data={"uv": 2}, dim=2, term="static_reprojection", stack=1)
def zoomed_reprojection(world_T_cam: Array, landmark: Array, intrinsics: Array, zoom: Array, *, uv: Array) -> Array:
    """Return (N, 2) px of poses (N, 4, 4), landmarks (N, 3), intrinsics (N, 4), zooms (N, 1) and pixels (N, 2)."""
    return uv - project(zoomed_intrinsics(intrinsics, zoom), world_to_camera(world_T_cam, landmark))


@zoomed_reprojection.jacobian
def zoomed_reprojection_jacobian(
    world_T_cam: FloatArray, landmark: FloatArray, intrinsics: FloatArray, zoom: FloatArray, *, uv: FloatArray
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobians: pose (N, 2, 6), landmark (N, 2, 3), intrinsics (N, 2, 4), zoom (N, 2)."""
    camera = np.asarray(zoomed_intrinsics(intrinsics, zoom))
    r, (pose, point, by_camera) = static_reprojection_jacobian(world_T_cam, landmark, camera, uv=uv)
    # d(fx, fy)/dl is (fx, fy) of the frame; their derivatives by those of the intrinsics are e^l.
    by_zoom = by_camera[:, :, :2] @ camera[:, :2, None]
    by_intrinsics = by_camera.copy()
    by_intrinsics[:, :, :2] *= np.exp(zoom)[:, None, :]
    return r, [pose, point, by_intrinsics, by_zoom]


@factor(ZOOM, ZOOM, dim=1)
def zoom_smoothness(zoom: Array, following: Array) -> Array:
    """Return (N, 1) of the zooms (N, 1) of frames and of those behind them."""
    return following - zoom


@zoom_smoothness.jacobian
def zoom_smoothness_jacobian(zoom: FloatArray, following: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the residual and its Jacobians (N, 1, 1)."""
    one = np.ones((len(zoom), 1, 1))
    return following - zoom, [-one, one]
