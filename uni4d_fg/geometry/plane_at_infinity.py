r"""Projective maps of space that a camera which zooms along its view cannot be told from.

Cameras and points that a projective map has moved still see the same pixels. One that moves the plane n.x = h, which
lies across the view, to infinity,

    x  ->  (x - o) / e(x),    e(x) = (n.x - h) / (n.o - h),

takes cameras c on its axis, the line along n through o, from a focal length f to f / e(c): motion along the view
becomes another one, with a zoom. So a camera without a zoom that was fitted to a video with one is nearly what such a
map makes of the right camera, and the plane is all that is to be found. Of cameras beside the axis, or turned against
it, the middle of the picture is kept; the rest is for bundle adjustment.

Where the plane lies between cameras and points, these change the side: near and far are exchanged. That is what a zoom
does that undoes the motion ("dolly zoom"): all that is behind one distance shrinks and all before it grows, which for a
camera without a zoom cannot be in front of it.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, sections 3.5 (plane at infinity) and 10.2
(projective ambiguity).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.geometry.se3 import orthonormalize


@dataclass(frozen=True)
class PlaneAtInfinity:
    """The map that moves a plane across the view to infinity."""

    normal: FloatArray
    """(3,) unit vector along the view, in the world."""
    offset: float
    """h: where the plane crosses the axis."""
    origin: FloatArray
    """(3,) o: a point of the axis, which is along the normal, beside the camera whose focal length stays."""
    scale: float
    """n.o - h; its sign says on which side of the plane cameras are."""
    exchanges: bool
    """Whether the points are on the other side of the plane than the cameras."""

    @classmethod
    def across(cls, world_T_cam: FloatArray, ratio: float, *, exchanges: bool = False) -> PlaneAtInfinity | None:
        """Return the plane that multiplies the focal length of the camera that is farthest ahead by a ratio.

        Args:
            world_T_cam: (T, 4, 4).
            ratio: Its focal length over that of the camera farthest behind; above 1 the plane lies ahead of them.
            exchanges: Whether points lie beyond it; then the ratio must be above 1.

        Returns:
            None if the cameras do not move along their view, or the ratio is 1.
        """
        normal = world_T_cam[:, :3, 2].mean(axis=0)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-12)
        along = world_T_cam[:, :3, 3] @ normal
        behind, ahead = float(along.min()), float(along.max())
        if ahead - behind <= 1e-9 * max(1.0, abs(ahead), abs(behind)) or ratio == 1.0:
            return None
        offset = (ratio * ahead - behind) / (ratio - 1.0)  # |behind - h| / |ahead - h| = ratio
        middle = world_T_cam[:, :3, 3].mean(axis=0)
        origin = middle + (along[0] - middle @ normal) * normal
        return cls(normal, offset, origin, float(along[0]) - offset, exchanges)

    def cameras(self, world_T_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return cameras (T, 4, 4) in the world that this map makes, and by what their focal lengths grow (T,)."""
        rotation, center = world_T_cam[:, :3, :3], world_T_cam[:, :3, 3]
        nearness = (center @ self.normal - self.offset) / self.scale  # e(c): positive, as cameras are on one side
        # The ray c + s v becomes, up to a factor, a ray from the new center along e(c) v - (n.v) (c - o) / scale.
        rays = nearness[:, None, None] * rotation - (
            (center - self.origin)[:, :, None] * (self.normal @ rotation)[:, None, :] / self.scale
        )
        length = np.linalg.norm(rays[:, :, 2], axis=1)
        view = rays[:, :, 2] / length[:, None]
        beside = rays[:, :, :2] - view[:, :, None] * np.einsum("ti,tij->tj", view, rays[:, :, :2])[:, None, :]
        steps = np.linalg.norm(beside, axis=1)
        out = world_T_cam.copy()
        out[:, :3, :3] = np.concatenate([beside / steps[:, None, :], view[:, :, None]], axis=2)
        out = orthonormalize(out)
        out[:, :3, 3] = (center - self.origin) / nearness[:, None]
        if self.exchanges:
            # Points are behind these cameras: they look the other way, in a mirrored world.
            out[:, :3, :3] = -self._mirror @ out[:, :3, :3]
            out[:, :3, 3] = out[:, :3, 3] @ self._mirror
        return out, length / np.sqrt(steps.prod(axis=1))

    @property
    def _mirror(self) -> FloatArray:
        return np.eye(3) - 2.0 * np.outer(self.normal, self.normal)
