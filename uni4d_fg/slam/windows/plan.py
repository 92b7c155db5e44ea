"""Which frames each window has, which of two windows owns an observation, and how their results are blended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.track_model import LabelledTracks

_MANY = 5
"""Windows of which one more makes each hardly shorter."""


@dataclass(frozen=True)
class Window:
    """Frames ``start`` to ``stop - 1``."""

    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def frames(self) -> IntArray:
        """(N,) its frame numbers."""
        return np.arange(self.start, self.stop)

    def __str__(self) -> str:
        return f"{self.start}-{self.stop - 1}"


def plan_windows(num_frames: int, frames: int, overlap: int) -> list[Window]:
    """Return windows of equal length, at most ``frames``, of which neighbors share ``overlap`` frames.

    No frame is in more than two windows. From :data:`_MANY` on their number is even: two workers, or four, then end
    with them together, and the plan is the same however many there are.

    Raises:
        ConfigError: If the overlap is more than a third of the frames.
    """
    if 3 * overlap > frames:
        raise ConfigError(
            f"windows.overlap {overlap} must be at most a third of windows.frames {frames}: give {frames // 3} or less"
        )
    if num_frames <= frames:
        return [Window(0, num_frames)]
    count = -(-(num_frames - overlap) // (frames - overlap))
    count += count % 2 if count >= _MANY else 0
    starts = np.linspace(0, num_frames - overlap, count + 1).round().astype(int)[:-1]
    ends = np.append(starts[1:] + overlap, num_frames)
    return [Window(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def windows_of(config: Config, num_frames: int) -> list[Window]:
    """Return the windows that a configuration asks for; empty for one graph.

    Raises:
        ConfigError: If the rest of the configuration cannot be solved in windows.
    """
    settings = config.windows
    if settings.frames is None:
        return []
    windows = plan_windows(num_frames, settings.frames, settings.overlap)
    if len(windows) < 2:
        return []
    if config.energy != "map" or config.solver != "lm" or not config.bundle_adjustment.depth_prior:
        raise ConfigError(
            "windows are joined by their information, which needs energy 'map', solver 'lm' and "
            "bundle_adjustment.depth_prior: choose the preset 'default' or 'fast', or leave windows.frames out"
        )
    if config.input.poses == "fixed":
        raise ConfigError("windows join poses that are estimated; with input.poses 'fixed' leave windows.frames out")
    return windows


@dataclass(frozen=True)
class WindowTracks:
    """The labelled tracks of some frames."""

    labelled: LabelledTracks
    """Frames are counted from the first of them, in their order."""
    track: IntArray
    """(k,) number of each in the whole video."""


def tracks_in(labelled: LabelledTracks, frames: IntArray) -> WindowTracks:
    """Cut out the tracks that have a trusted observation in some frames (N,), ascending.

    The frame in which a track was started, which may be none of these, is counted by their mean spacing.
    """
    step = float(np.diff(frames).mean()) if len(frames) > 1 else 1.0
    query_frame = np.rint((labelled.tracks.query_frame - frames[0]) / step).astype(np.int32)
    cut = labelled.in_frames(frames, query_frame)
    keep = np.flatnonzero((cut.weight > 0).any(axis=1))
    return WindowTracks(cut.select(keep), keep)


@dataclass(frozen=True)
class TrackSpans:
    """Where the tracks of a video begin and end."""

    first: IntArray
    """(K,) first frame with a trusted observation."""
    last: IntArray
    """(K,) last."""
    count: IntArray
    """(K,) number of trusted observations."""

    @classmethod
    def of(cls, labelled: LabelledTracks) -> TrackSpans:
        """Read them off the labelled tracks."""
        seen = labelled.weight > 0
        last = seen.shape[1] - 1 - np.argmax(seen[:, ::-1], axis=1)
        return cls(np.argmax(seen, axis=1), last, seen.sum(axis=1))


def owned_range(
    first: IntArray, last: IntArray, track: IntArray, windows: list[Window], index: int
) -> tuple[IntArray, IntArray]:
    """Return from which frame on (n,) and before which frame (n,) a window owns the observations of tracks.

    An observation in an overlap is solved for by both windows, and counts once when they are joined. A track that
    ends in an overlap belongs to the earlier window, one that begins there to the later. Others change hands at a
    frame that differs from track to track, so that no frame of the overlap loses its ties to the next.

    Args:
        first: (n,) first observed frame of each track.
        last: (n,) last.
        track: (n,) numbers of the tracks.
        windows: All windows.
        index: Which of them.
    """
    none, all_ = np.full(len(track), -1), np.full(len(track), np.iinfo(np.int64).max)
    lower = none if index == 0 else _change(first, last, track, windows[index - 1], windows[index])
    upper = all_ if index == len(windows) - 1 else _change(first, last, track, windows[index], windows[index + 1])
    return lower, upper


def _change(first: IntArray, last: IntArray, track: IntArray, earlier: Window, later: Window) -> IntArray:
    """Return the first frame (n,) that the later window owns."""
    width = earlier.stop - later.start
    # Knuth's multiplicative hash: neighboring tracks of a grid change hands at unrelated frames.
    spread = later.start + 1 + (track.astype(np.int64) * 2654435761 >> 7) % max(width - 1, 1)
    result: IntArray = np.where(last < earlier.stop, earlier.stop, np.where(first >= later.start, later.start, spread))
    return result


def middle_frames(windows: list[Window], index: int) -> BoolArray:
    """Return which frames (N,) of a window are on its side of the middle of each overlap."""
    window = windows[index]
    lower = window.start if index == 0 else (window.start + windows[index - 1].stop + 1) // 2
    upper = window.stop if index == len(windows) - 1 else (windows[index + 1].start + window.stop + 1) // 2
    result: BoolArray = (window.frames >= lower) & (window.frames < upper)
    return result


def blend_weight(windows: list[Window], index: int) -> FloatArray:
    """Return the weight (N,) of a window's frames in the joined result; neighbors' weights add up to one."""
    window, weight = windows[index], np.ones(len(windows[index]))
    if index > 0:
        width = windows[index - 1].stop - window.start
        weight[:width] = (np.arange(width) + 1.0) / (width + 1.0)
    if index < len(windows) - 1:
        width = window.stop - windows[index + 1].start
        weight[len(window) - width :] = 1.0 - (np.arange(width) + 1.0) / (width + 1.0)
    return weight


def calibration_frames(spans: TrackSpans, num_frames: int, frames: int, sightings: int) -> IntArray:
    """Return evenly spaced frames, at most ``frames``, that the tracks still tie together.

    The focal length shows best in long baselines: the frames are as far apart as the video allows, but at most so
    that an average track (by its observations) is seen in ``sightings`` of them.
    """
    length = np.maximum(spans.count, 1)
    typical = float(np.average(length, weights=length))
    stride = max(1, min(-(-num_frames // frames), int(typical / sightings)))
    return np.arange(0, num_frames, stride)[:frames]
