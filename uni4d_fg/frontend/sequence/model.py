"""The one description of a video and its cues, whatever folder layout it came from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, Int32Array
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.lens import PINHOLE, Lens

T_co = TypeVar("T_co", covariant=True)


@runtime_checkable
class FrameSource(Protocol[T_co]):
    """A lazily read list of per-frame arrays: nothing is decoded until it is indexed."""

    def __len__(self) -> int: ...

    def __getitem__(self, frame: int) -> T_co: ...

    def __iter__(self) -> Iterator[T_co]: ...


@dataclass(frozen=True)
class ArrayFrames:
    """In-memory frames (or a memory map) with the interface of :class:`FrameSource`."""

    array: np.ndarray  # (T, ...)

    def __len__(self) -> int:
        return len(self.array)

    def __getitem__(self, frame: int) -> np.ndarray:
        return np.asarray(self.array[frame])

    def __iter__(self) -> Iterator[np.ndarray]:
        return (np.asarray(a) for a in self.array)


@dataclass(frozen=True)
class GroundTruth:
    """What is known of the truth; every field may be absent. Used by evaluation only, never by the solver."""

    world_T_cam: FloatArray | None = None
    """(T, 4, 4) camera to world, OpenCV axes, meters; NaN where unknown."""
    depths: FrameSource[Float32Array] | None = None
    """T maps (H, W), meters; NaN where unknown."""
    masks: FrameSource[Int32Array] | None = None
    """T label maps (H, W), 0 static; what really moves."""
    intrinsics: FloatArray | None = None
    """(4,) fx, fy, cx, cy, px; the mean where the camera zooms."""
    track_points: FloatArray | None = None
    """(K, T, 3) world position of each of the sequence's own tracks, meters; NaN where unknown."""
    rigid_instance: Int32Array | None = None
    """(J,) mask ids of the instances that move rigidly."""
    world_T_object: FloatArray | None = None
    """(J, T, 4, 4) their poses, meters; the origin and axes of an object's frame are arbitrary, but fixed to it."""


@dataclass(frozen=True)
class Content:
    """The part of the images that shows something; ``bottom`` and ``right`` are the first row and column behind it."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


class _SelfCalibration:
    """What :class:`Video` and :class:`Sequence` say of cameras that were found from their motion."""

    depth_parallax: bool | None
    focal_sigma: float | None

    @property
    def is_self_calibrated(self) -> bool:
        """Whether camera motion told the intrinsics or, with them, the depth: they are doubted where they are found."""
        return self.focal_sigma is not None or self.depth_parallax is not None


@dataclass(frozen=True)
class Video(_SelfCalibration):
    """What came in: frames, and the cues that came with them; :mod:`uni4d_fg.cues` makes those that are missing.

    Conventions as in :class:`Sequence`.
    """

    name: str
    images: FrameSource[ImageArray]
    """T images (H, W, 3), uint8 RGB, upright."""
    image_size: tuple[int, int]
    """(height, width), px."""
    timestamps: FloatArray
    """(T,) seconds, strictly increasing; frame index when unknown."""
    depths: FrameSource[Float32Array] | None = None
    """T maps (H, W), float32 meters, NaN where missing."""
    depth_is_metric: bool = True
    """Whether depth is in meters; else it is in a unit of its own."""
    depth_parallax: bool | None = None
    """Of depth that was found from camera motion alone: whether that showed parallax. None for other depth."""
    focal_sigma: float | None = None
    """Standard deviation of the log focal length where camera motion told the intrinsics; else None."""
    masks: FrameSource[Int32Array] | None = None
    """T label maps (H, W), int32."""
    masks_from_motion: bool = False
    """Whether masks were found from motion: what they hide by mistake is told by depth that several frames show. What
    given masks hide may follow the camera, and seem to stand still farther away."""
    intrinsics: FloatArray | None = None
    """(4,) fx, fy, cx, cy in px."""
    lens: Lens = PINHOLE
    """What is known of its distortion; the pinhole where nothing is."""
    zoom: FloatArray | None = None
    """(T,) focal length of each frame over that of the intrinsics, at most 1, where it is known that it changes."""
    tracks: Tracks | None = None
    root: Path | None = None
    """Folder or file it was read from, if any."""
    frame_names: tuple[str, ...] = ()
    """T stems used to name per-frame outputs."""
    initial_world_T_cam: FloatArray | None = None
    """(T, 4, 4)."""
    ground_truth: GroundTruth = field(default_factory=GroundTruth)
    content: Content | None = None
    """What lies between black bars; None where nobody has looked for any."""

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return len(self.images)


@dataclass(frozen=True)
class Sequence(_SelfCalibration):
    """One video with all its cues.

    Conventions: pixel centers at integers; depth is z-depth in meters, NaN where missing (readers turn
    zero, negative and infinite values into NaN); mask 0 is static and > 0 an instance that may move.
    """

    name: str
    images: FrameSource[ImageArray]
    """T images (H, W, 3), uint8 RGB."""
    depths: FrameSource[Float32Array]
    """T maps (H, W), float32 meters, NaN where missing."""
    masks: FrameSource[Int32Array]
    """T label maps (H, W), int32."""
    intrinsics: FloatArray
    """(4,) fx, fy, cx, cy in px: known, or an initial value when the config frees them."""
    image_size: tuple[int, int]
    """(height, width), px."""
    timestamps: FloatArray
    """(T,) seconds, strictly increasing; frame index when unknown."""
    root: Path | None = None
    """Folder it was read from, if any."""
    frame_names: tuple[str, ...] = ()
    """T stems of the image files ("00000", ...), used to name per-frame outputs."""
    initial_world_T_cam: FloatArray | None = None
    """(T, 4, 4) poses to start from or to keep, as the config says."""
    depth_is_metric: bool = True
    """Whether depth is in meters; else it is in a unit of its own."""
    depth_parallax: bool | None = None
    """Of depth that was found from camera motion alone: whether that showed parallax. None for other depth."""
    focal_sigma: float | None = None
    """Standard deviation of the log focal length where camera motion told the intrinsics; else None."""
    masks_from_motion: bool = False
    """See :attr:`Video.masks_from_motion`."""
    intrinsics_are_guessed: bool = False
    """Whether no intrinsics were given, and they are a guess from the size of the images."""
    tracks: Tracks | None = None
    """Long 2D point tracks, when the sequence brings them."""
    lens: Lens = PINHOLE
    """What is known of its distortion; the pinhole where nothing is."""
    zoom: FloatArray | None = None
    """(T,) focal length of each frame over that of the intrinsics, at most 1, where it is known that it changes."""
    ground_truth: GroundTruth = field(default_factory=GroundTruth)
    content: Content | None = None
    """What lies between black bars; None where nobody has looked for any."""

    @property
    def given_intrinsics(self) -> FloatArray | None:
        """(4,) px that somebody vouches for; None where they are guessed."""
        return None if self.intrinsics_are_guessed else self.intrinsics

    @property
    def num_frames(self) -> int:
        """Number of frames T."""
        return len(self.images)
