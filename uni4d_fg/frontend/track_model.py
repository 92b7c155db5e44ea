"""Point tracks over a video and their labels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, Int32Array, IntArray
from uni4d_fg.errors import InputError


class TrackLabel(IntEnum):
    """What a track belongs to."""

    STATIC = 0
    """Static in every frame in which it is surely seen, and long enough to carry a camera."""
    DYNAMIC = 1
    """On one moving instance in every frame in which it is surely seen."""
    SHORT_STATIC = 2
    """Static but seen in too few frames for camera initialization; used after bundle adjustment."""
    REJECTED = 3
    """Mixed, never surely seen, or switching between instances."""


@dataclass(frozen=True)
class Tracks:
    """K point tracks over T frames.

    Raises:
        InputError: If shapes or dtypes disagree, or a visible observation is not finite.
    """

    uv: Float32Array
    """(K, T, 2) pixels, NaN where not visible."""
    visible: BoolArray
    """(K, T)."""
    query_frame: Int32Array
    """(K,) frame in which the track was started, in [0, T)."""
    confidence: Float32Array | None = None
    """(K, T) in [0, 1], when the tracker gives one."""
    blur_px: Float32Array | None = None
    """(T,) length of the camera's motion blur in each frame, 0 where sharp, when the tracker tells it."""

    def __post_init__(self) -> None:
        k, t = self.visible.shape if self.visible.ndim == 2 else (-1, -1)
        if self.uv.shape != (k, t, 2) or self.query_frame.shape != (k,):
            raise InputError(
                f"tracks: uv {self.uv.shape}, visible {self.visible.shape} and query_frame "
                f"{self.query_frame.shape} must be (K, T, 2), (K, T) and (K,)"
            )
        if self.visible.dtype != np.bool_:
            raise InputError(f"tracks: visible must be bool, got {self.visible.dtype}")
        if self.confidence is not None and self.confidence.shape != (k, t):
            raise InputError(f"tracks: confidence {self.confidence.shape} must be ({k}, {t})")
        if self.blur_px is not None and self.blur_px.shape != (t,):
            raise InputError(f"tracks: blur_px {self.blur_px.shape} must be ({t},)")
        finite = np.isfinite(self.uv[..., 0]) & np.isfinite(self.uv[..., 1])
        if bool((self.visible & ~finite).any()):
            raise InputError("tracks: a visible observation is NaN or infinite; mark it not visible instead")

    @property
    def num_tracks(self) -> int:
        """Number of tracks K."""
        return int(self.visible.shape[0])

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return int(self.visible.shape[1])

    def select(self, keep: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> Tracks:
        """Return the tracks picked by a boolean mask or by indices."""
        confidence = None if self.confidence is None else self.confidence[keep]
        return Tracks(self.uv[keep], self.visible[keep], self.query_frame[keep], confidence, self.blur_px)

    def without(self, dropped: BoolArray) -> Tracks:
        """Return the same tracks with some observations, (K, T), not visible."""
        uv = np.where(dropped[..., None], np.float32(np.nan), self.uv)
        return replace(self, uv=uv, visible=self.visible & ~dropped)

    def in_frames(self, frames: IntArray, query_frame: Int32Array) -> Tracks:
        """Return what is seen in some frames (t,), of tracks that were started in frames (K,), counted among these."""
        confidence = None if self.confidence is None else self.confidence[:, frames]
        blur_px = None if self.blur_px is None else self.blur_px[frames]
        return Tracks(self.uv[:, frames], self.visible[:, frames], query_frame, confidence, blur_px)


@dataclass(frozen=True)
class LabelledTracks:
    """Tracks with what each belongs to and which observations to trust."""

    tracks: Tracks
    label: Int32Array
    """(K,) values of :class:`TrackLabel`."""
    instance: Int32Array
    """(K,) mask id of the moving instance; 0 for every track that is not DYNAMIC."""
    weight: Float32Array
    """(K, T) in [0, 1]: 0 where not visible or dropped, below 1 inside the uncertain band of a mask."""
    depth: Float32Array
    """(K, T) meters: the depth cue at each observation (bilinear), NaN where missing or not visible."""

    def counts(self) -> dict[str, int]:
        """Return the number of tracks per label name."""
        return {label.name.lower(): int((self.label == label).sum()) for label in TrackLabel}

    def select(self, keep: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> LabelledTracks:
        """Return the tracks picked by a boolean mask or by indices."""
        return LabelledTracks(
            self.tracks.select(keep), self.label[keep], self.instance[keep], self.weight[keep], self.depth[keep]
        )

    def in_frames(self, frames: IntArray, query_frame: Int32Array) -> LabelledTracks:
        """Return what is seen in some frames (t,), of tracks that were started in frames (K,), counted among these."""
        tracks = self.tracks.in_frames(frames, query_frame)
        return replace(self, tracks=tracks, weight=self.weight[:, frames], depth=self.depth[:, frames])

    def without(self, rejected: BoolArray) -> LabelledTracks:
        """Return the same tracks with some of them, (K,), rejected."""
        label = np.where(rejected, np.int32(TrackLabel.REJECTED), self.label).astype(np.int32)
        return replace(self, label=label, weight=np.where(rejected[:, None], np.float32(0), self.weight))
