"""Where the viewer looks from at first: behind and above the first camera, at what moves, beside the panel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.results.pictures.figure import upright_axes
from uni4d_fg.slam.reconstruction import Reconstruction

FOV_RAD = float(np.radians(50.0))
_PANEL_PART = 0.1
"""Half of the part of a wide window's width that the panel covers."""
_USUAL_ASPECT = 16.0 / 9.0
_BACK, _UP, _ASIDE = 0.6, 0.35, 0.3
"""Place of the view behind, above and beside the first camera, in parts of its distance to the subject."""


@dataclass(frozen=True)
class Framing:
    """A view of the scene."""

    position: FloatArray
    """(3,) meters."""
    look_at: FloatArray
    """(3,) meters."""
    up: FloatArray
    """(3,) unit vector."""


def subject_of(reconstruction: Reconstruction, depth: float) -> FloatArray:
    """Return the middle (3,) of what the video is about at its start: what moves, else what the camera looks at.

    Args:
        reconstruction: Cameras and points.
        depth: Usual depth of the scene, meters.
    """
    for points in (reconstruction.dynamic_points[:, 0], reconstruction.dynamic_points.reshape(-1, 3)):
        known = points[np.isfinite(points).all(axis=1)]
        if len(known):
            return np.asarray(np.median(known, axis=0))
    first = reconstruction.world_T_cam[0]
    return np.asarray(first[:3, 3] + depth * first[:3, 2])


def first_view(reconstruction: Reconstruction, depth: float, aspect: float = _USUAL_ASPECT) -> Framing:
    """Choose the view that shows the subject and the first camera in front of it.

    Args:
        reconstruction: Cameras and points.
        depth: Usual depth of the scene, meters.
        aspect: Width of the window over its height: a narrow one has no panel at its side, and is looked at from
            farther away.
    """
    _, _, up = upright_axes(reconstruction.world_T_cam)
    camera, subject = reconstruction.world_T_cam[0, :3, 3], subject_of(reconstruction, depth)
    gaze = subject - camera
    distance = max(float(np.linalg.norm(gaze)), 1e-3 * depth)
    forward = gaze - (gaze @ up) * up
    if np.linalg.norm(forward) < 1e-3 * distance:
        forward = reconstruction.world_T_cam[0, :3, 2] - (reconstruction.world_T_cam[0, :3, 2] @ up) * up
    if np.linalg.norm(forward) < 1e-9:
        forward = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    narrow = aspect < 1.0
    back = _BACK + (0.6 if narrow else 0.0)
    aside = 0.0 if narrow else _ASIDE
    position = camera + distance * (aside * right - back * forward + _UP * up)
    seen_from = float(np.linalg.norm(subject - position))
    width = 2.0 * seen_from * float(np.tan(0.5 * FOV_RAD)) * aspect
    shift = 0.0 if narrow else _PANEL_PART * width
    return Framing(position, subject + shift * right, up)
