"""Which frames of a video are used, and how large; applied to images and every cue alike."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.frames import SelectedFrames
from uni4d_fg.frontend.sequence.model import GroundTruth, Video
from uni4d_fg.frontend.sequence.resize import resize_video
from uni4d_fg.frontend.track_model import Tracks

MIN_FRAMES = 2
"""Fewer frames hold no motion."""
MIN_SIZE = 16
"""Smallest longer side in px that can be asked for."""


@dataclass(frozen=True)
class FrameSelection:
    """Frames ``start``, ``start + stride``, ... before ``stop``, no larger than ``max_size``.

    Raises:
        InputError: If a number is out of range or ``stop`` does not lie behind ``start``.
    """

    start: int = 0
    """First frame."""
    stop: int | None = None
    """First frame that is left out; None for the end. May lie beyond the end."""
    stride: int = 1
    """Distance from one frame to the next."""
    max_size: int | None = None
    """Longer side, px: larger images are made smaller, with everything that belongs to them. None keeps the size."""

    def __post_init__(self) -> None:
        if self.start < 0:
            raise InputError(f"frame selection: start is {self.start}; count frames from 0")
        if self.stop is not None and self.stop <= self.start:
            raise InputError(
                f"frame selection: stop ({self.stop}) does not lie behind start ({self.start}); "
                "stop is the first frame that is left out"
            )
        if self.stride < 1:
            raise InputError(f"frame selection: stride is {self.stride}; give 1 or more")
        if self.max_size is not None and self.max_size < MIN_SIZE:
            raise InputError(f"frame selection: a largest size of {self.max_size} px; give {MIN_SIZE} px or more")

    def indices(self, num_frames: int) -> IntArray:
        """Return the selected frames of a video of ``num_frames``, increasing."""
        # Python's numbers have no largest one, those of arrays do.
        stop = num_frames if self.stop is None else min(self.stop, num_frames)
        return np.arange(min(self.start, num_frames), stop, min(self.stride, num_frames + 1), dtype=np.int64)


def select_frames(video: Video, selection: FrameSelection) -> Video:
    """Return the selected part of a video, in the selected size; nothing is decoded.

    Poses, timestamps and truth follow the frames. A track keeps its observations in the selected frames, and
    is left out (with its true path) if there are none; its query frame becomes the nearest selected one.

    Raises:
        InputError: If fewer than two frames are left.
    """
    frames = selected_frames(selection, video.num_frames, video.root or video.name)
    if len(frames) < video.num_frames:
        video = _take(video, frames)
    return video if selection.max_size is None else resize_video(video, selection.max_size)


def selected_frames(selection: FrameSelection, num_frames: int, where: Path | str) -> IntArray:
    """Return the selected frames of a video of ``num_frames``, increasing.

    Raises:
        InputError: If fewer than two are left.
    """
    frames = selection.indices(num_frames)
    if len(frames) < MIN_FRAMES:
        raise InputError(
            f"{where}: the selection leaves {len(frames)} of {num_frames} frames; "
            f"choose start, stop and stride so that at least {MIN_FRAMES} are left"
        )
    return frames


def _take(video: Video, frames: IntArray) -> Video:
    truth = video.ground_truth
    tracks, points = video.tracks, truth.track_points
    if tracks is not None:
        seen: BoolArray = np.asarray(tracks.visible[:, frames].any(axis=1))
        tracks = _take_of_tracks(tracks.select(seen), frames)
        points = None if points is None else points[seen][:, frames]
    return replace(
        video,
        images=SelectedFrames(video.images, frames),
        timestamps=video.timestamps[frames],
        depths=None if video.depths is None else SelectedFrames(video.depths, frames),
        masks=None if video.masks is None else SelectedFrames(video.masks, frames),
        tracks=tracks,
        frame_names=tuple(video.frame_names[frame] for frame in frames) if video.frame_names else (),
        initial_world_T_cam=_of_poses(video.initial_world_T_cam, frames),
        zoom=None if video.zoom is None else video.zoom[frames],
        ground_truth=GroundTruth(
            world_T_cam=_of_poses(truth.world_T_cam, frames),
            depths=None if truth.depths is None else SelectedFrames(truth.depths, frames),
            masks=None if truth.masks is None else SelectedFrames(truth.masks, frames),
            intrinsics=truth.intrinsics,
            track_points=points,
            rigid_instance=truth.rigid_instance,
            world_T_object=None if truth.world_T_object is None else truth.world_T_object[:, frames],
        ),
    )


def _of_poses(poses: FloatArray | None, frames: IntArray) -> FloatArray | None:
    return None if poses is None else poses[frames]


def _take_of_tracks(tracks: Tracks, frames: IntArray) -> Tracks:
    middle = (frames[1:] + frames[:-1]) / 2
    return tracks.in_frames(frames, np.searchsorted(middle, tracks.query_frame).astype(np.int32))
