"""What goes into and comes out of the incremental solver, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, ImageArray, IntArray
from uni4d_fg.errors import InputError


@dataclass(frozen=True)
class FrameTracks:
    """Tracked points of one frame.

    Raises:
        InputError: If shapes disagree, a number stands twice or is negative, or a pixel is not finite.
    """

    track: IntArray
    """(n,) number of each track, the same in every frame that sees it."""
    uv: FloatArray
    """(n, 2) px."""

    def __post_init__(self) -> None:
        if self.track.ndim != 1 or self.uv.shape != (len(self.track), 2):
            raise InputError(f"tracks of a frame: track {self.track.shape} and uv {self.uv.shape} must be (n,), (n, 2)")
        if len(np.unique(self.track)) != len(self.track) or (self.track < 0).any():
            raise InputError("tracks of a frame: numbers must be distinct and not negative")
        if not np.isfinite(self.uv).all():
            raise InputError("tracks of a frame: a pixel is NaN or infinite; leave that track out")


class FrameStatus(str, Enum):
    """What became of a frame."""

    KEYFRAME = "keyframe"
    """Its pose and observations joined the window."""
    TRACKED = "tracked"
    """Posed against the landmarks; it adds too little to join the window (a camera at rest)."""
    BRIDGED = "bridged"
    """Too few tracks: its pose is that of the motion prior, and its covariance says how uncertain it is."""
    REPEATED = "repeated"
    """Ignored: its timestamp is that of the frame before."""
    OUT_OF_ORDER = "out of order"
    """Ignored: its timestamp is earlier than that of the frame before."""


@dataclass(frozen=True)
class DynamicPoints:
    """Moving points of one frame."""

    track: IntArray
    """(m,)."""
    instance: IntArray
    """(m,) mask ids."""
    point: FloatArray
    """(m, 3) meters."""
    observed: BoolArray
    """(m,) False where a hidden point was bridged."""
    color: ImageArray
    """(m, 3) RGB."""

    @classmethod
    def none(cls) -> DynamicPoints:
        """Return no points."""
        empty = np.zeros(0, dtype=np.int64)
        return cls(empty, empty, np.zeros((0, 3)), np.zeros(0, dtype=bool), np.zeros((0, 3), dtype=np.uint8))


@dataclass(frozen=True)
class Landmarks:
    """Static points."""

    track: IntArray
    """(n,)."""
    point: FloatArray
    """(n, 3) world, meters."""
    error: FloatArray
    """(n,) median reprojection error, px."""
    count: IntArray
    """(n,) observations."""
    color: ImageArray
    """(n, 3) RGB."""
    keyframe: IntArray
    """(n,) frame number of the keyframe that they left the window with."""


@dataclass(frozen=True)
class FinishedFrame:
    """A frame that has left the window: nothing of it changes any more."""

    frame: int
    timestamp: float
    status: FrameStatus
    world_T_cam: FloatArray
    """(4, 4)."""
    covariance: FloatArray
    """(6, 6) of the body-frame twist (rad, m), relative to the first camera; NaN if not determined."""
    log_scale: float
    dynamic: DynamicPoints
    """In the world."""


@dataclass(frozen=True)
class FrameUpdate:
    """What :meth:`IncrementalReconstructor.add_frame` returns."""

    status: FrameStatus
    frame: int
    """Number of the frame; of an ignored one, that of the frame before."""
    world_T_cam: FloatArray
    """(4, 4) present estimate."""
    covariance: FloatArray
    """(6, 6), see :class:`FinishedFrame`."""
    landmark_track: IntArray
    """(n,) tracks of all landmarks in the window; all of them may have moved."""
    landmarks: FloatArray
    """(n, 3)."""
    dynamic: DynamicPoints
    """Moving points of this frame, world."""
    finished: tuple[FinishedFrame, ...] = ()
    """Frames that left the window, in order."""
    finished_landmarks: tuple[Landmarks, ...] = ()
    reprojection_error_px: float = float("nan")
    """Median of the window."""
    num_tracks: int = 0
    """Static tracks that the frame's pose rests on."""
    window: int = 0
    """Keyframes in the window."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time per part: track, pose, window, covariance, marginalize, nonrigid."""
