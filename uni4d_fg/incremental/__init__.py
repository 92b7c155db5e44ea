"""Incremental, windowed solving of a video of any length in bounded memory."""

from uni4d_fg.incremental.model import DynamicPoints, FinishedFrame, FrameStatus, FrameTracks, FrameUpdate, Landmarks
from uni4d_fg.incremental.reconstructor import IncrementalReconstructor

__all__ = [
    "DynamicPoints",
    "FinishedFrame",
    "FrameStatus",
    "FrameTracks",
    "FrameUpdate",
    "IncrementalReconstructor",
    "Landmarks",
]
