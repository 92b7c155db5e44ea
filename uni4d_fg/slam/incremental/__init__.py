"""Incremental, windowed solving of a video of any length in bounded memory; it reads and writes no files."""

from uni4d_fg.slam.incremental.model import (
    DynamicPoints,
    FinishedFrame,
    FrameStatus,
    FrameTracks,
    FrameUpdate,
    Landmarks,
)
from uni4d_fg.slam.incremental.reconstructor import IncrementalReconstructor

__all__ = [
    "DynamicPoints",
    "FinishedFrame",
    "FrameStatus",
    "FrameTracks",
    "FrameUpdate",
    "IncrementalReconstructor",
    "Landmarks",
]
