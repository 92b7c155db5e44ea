"""What the panel asks for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Shown:
    """State of the panel."""

    frame: int = 0
    static: bool = True
    landmarks: bool = False
    moving: bool = True
    full: bool = True
    """Every pixel of the current frame, while the time stands still."""
    trajectories: bool = True
    objects: bool = True
    """Axes of rigid objects."""
    cameras: bool = True
    images: bool = True
    history: int = 0
    """Moving clouds of this many earlier frames are shown as well."""
    trail: int = 10
    """Length of the trails, frames."""
    point_size: float = 1.0
    """Factor on the size at which neighboring points touch."""
