"""Pictures of a result: camera path, depth strip, views of the 4D cloud. Loaded when asked for: matplotlib is large."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uni4d_fg.results.pictures.depth_strip import draw_depth_strip
    from uni4d_fg.results.pictures.scene import draw_scene
    from uni4d_fg.results.pictures.trajectory import draw_trajectory

__all__ = ["draw_depth_strip", "draw_scene", "draw_trajectory", "load"]

_HOME = {"draw_depth_strip": "depth_strip", "draw_scene": "scene", "draw_trajectory": "trajectory"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def load() -> None:
    """Load all of it now: a third of a second, which a thread can spend while others work."""
    for home in _HOME.values():
        import_module(f"{__name__}.{home}")
