"""The built-in tracker: grids of points followed by pyramidal Lucas-Kanade, forwards and backwards in time.

A grid of query points is started in frames 0, ``query_interval``, 2 ``query_interval``, ... Two sweeps over
the video follow them: one forwards, in which every grid joins as the sweep passes its frame, and one
backwards. A step moves all live points of all grids at once, however many grids there are
(:mod:`uni4d_fg.frontend.tracks.guided_search`). It is checked backwards, or with refinement ends where the first
views of the points are (:mod:`uni4d_fg.frontend.tracks.first_views`), so that errors do not add up; optionally it is
checked for drift. Only the two images of the step are held, the first views of live points, some images of the last
steps for what was hidden, and for the drift check the gray query images.

A point that fails a check of :mod:`uni4d_fg.frontend.tracks.optical_flow` is lost. What was hidden can be looked for
again (:mod:`uni4d_fg.frontend.tracks.bridging`). Where the forward sweep leaves a cell of the image empty between two
grids, a new point starts (:mod:`uni4d_fg.frontend.tracks.reseeding`), and is followed both ways as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray, Int32Array, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.bridging import Bridges
from uni4d_fg.frontend.tracks.followed_points import FollowedPoints
from uni4d_fg.frontend.tracks.interruption import is_interrupted
from uni4d_fg.frontend.tracks.optical_flow import has_not_drifted
from uni4d_fg.frontend.tracks.reseeding import corners_of_empty_cells

Progress = Callable[[int, int], None]
"""Called with the number of steps done and the number of steps in all."""
ShouldStop = Callable[[], bool]
"""Asked between steps; True ends the work with :class:`~uni4d_fg.errors.Cancelled`."""

_BRIDGED = 25
"""`bridge_frames` where tracks are interrupted and the configuration leaves it open."""
_Observations = list[tuple[int, IntArray, Float32Array]]  # frame, track indices (n,), pixels (n, 2)


def query_grid(image_size: tuple[int, int], config: TrackingConfig) -> Float32Array:
    """Return the query points (rows * columns, 2) in px, row by row, of an image of (height, width)."""
    height, width = image_size
    # On a tiny image the margin must not push the two sides past each other.
    margin_x = min(config.margin_px, (width - 1) / 2)
    margin_y = min(config.margin_px, (height - 1) / 2)
    columns = np.linspace(margin_x, width - 1 - margin_x, config.grid_columns)
    rows = np.linspace(margin_y, height - 1 - margin_y, config.grid_rows)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return grid.astype(np.float32)


def track_grid(
    images: FrameSource[ImageArray],
    config: TrackingConfig,
    progress: Progress | None = None,
    should_stop: ShouldStop | None = None,
) -> Tracks:
    """Track grids of points through a video.

    Args:
        images: T images (H, W, 3) uint8 RGB, or (H, W) uint8 gray; each is read twice, in order, and twice again if
            `bridge_frames` is None and :func:`~uni4d_fg.frontend.tracks.interruption.is_interrupted` says so.
        config: Grid, window and checks.
        progress: Told the steps done and to do after every step.
        should_stop: Asked before every step.

    Returns:
        The tracks seen in at least ``min_observations`` frames (or in all, if the video is shorter).

    Raises:
        InputError: If the images differ in size or are not uint8.
        Cancelled: If ``should_stop`` said so.
    """
    if len(images) == 0:
        raise InputError("tracking: the sequence has no images")
    tracks = _swept(images, config, progress, should_stop)
    if config.bridge_frames is None and is_interrupted(tracks.visible):
        bridged = config.model_copy(update={"bridge_frames": _BRIDGED})
        tracks = _swept(images, bridged, progress, should_stop)
    return tracks


def _swept(
    images: FrameSource[ImageArray], config: TrackingConfig, progress: Progress | None, should_stop: ShouldStop | None
) -> Tracks:
    num_frames = len(images)
    image_size = _gray(images[0], None, 0).shape
    grid = query_grid((image_size[0], image_size[1]), config)
    queries: dict[int, _Queries] = {}
    observations: _Observations = []
    blur_px = np.zeros(num_frames, np.float32)
    steps_done, steps = 0, 2 * (num_frames - 1)
    for forwards in (True, False):
        live = _Sweep(FollowedPoints(config))
        previous: ImageArray | None = None
        for frame in range(num_frames) if forwards else range(num_frames - 1, -1, -1):
            if should_stop is not None and should_stop():
                raise Cancelled(f"tracking stopped at step {steps_done} of {steps}")
            image = _gray(images[frame], image_size, frame)
            if previous is not None:
                live.move(previous, image)
                blur_px[frame] = max(blur_px[frame], live.followed.blur_px)
                observations.append((frame, live.followed.track, live.followed.points))
                steps_done += 1
                if progress is not None:
                    progress(steps_done, steps)
            if forwards:
                started = _new_queries(frame, image, grid, live.followed.points, config)
                queries[frame] = _Queries(queries[frame - 1].end if frame else 0, started)
                observations.append((frame, queries[frame].tracks(), started))
            live.start(queries[frame], image)
            previous = image
    query_frame = np.repeat(
        np.arange(num_frames, dtype=np.int32), [len(queries[frame].points) for frame in range(num_frames)]
    )
    return replace(_assemble(observations, query_frame, num_frames, config.min_observations), blur_px=blur_px)


@dataclass(frozen=True)
class _Queries:
    """The tracks that start in one frame; they are numbered in the order of frames."""

    first: int
    points: Float32Array  # (n, 2) px

    @property
    def end(self) -> int:
        return self.first + len(self.points)

    def tracks(self) -> IntArray:
        return np.arange(self.first, self.end, dtype=np.int64)


def _new_queries(
    frame: int, image: ImageArray, grid: Float32Array, live: Float32Array, config: TrackingConfig
) -> Float32Array:
    """Return where tracks start in a frame of the forward sweep in which others are at ``live``, (n, 2) px."""
    return grid if frame % config.query_interval == 0 else corners_of_empty_cells(image, live, config)


@dataclass
class _Sweep:
    """What one sweep through the video follows at present."""

    followed: FollowedPoints
    origins: list[tuple[_Queries, ImageArray]] = field(default_factory=list)
    """Where the points started, and the image there; only for the drift check."""
    bridges: Bridges | None = field(init=False)
    """The points that were lost from sight, if they are looked for."""

    def __post_init__(self) -> None:
        config = self.followed.config
        self.bridges = Bridges(config, config.bridge_frames) if config.bridge_frames else None

    def start(self, queries: _Queries, image: ImageArray) -> None:
        """Add points in the frame where they start."""
        if len(queries.points) == 0:
            return
        self.followed.add(image, queries.tracks(), queries.points)
        if self.followed.config.max_drift_px is not None:
            self.origins.append((queries, image))

    def move(self, source: ImageArray, target: ImageArray) -> None:
        """Follow all points to the next image, forget those that are lost, and take up those in sight again."""
        followed = self.followed
        followed.move(source, target)
        if self.bridges is not None:
            again, where = self.bridges.find(target, followed.track, followed.points)
            if len(again):
                followed.add(target, again, where)
        if followed.config.max_drift_px is not None:
            self._forget_drifted(target)

    def _forget_drifted(self, image: ImageArray) -> None:
        followed, config = self.followed, self.followed.config
        keep = np.ones(len(followed.track), np.bool_)
        alive = []
        for queries, origin in self.origins:
            members = np.flatnonzero((followed.track >= queries.first) & (followed.track < queries.end))
            first = queries.points[followed.track[members] - queries.first]
            keep[members] = has_not_drifted(origin, image, first, followed.points[members], config)
            if keep[members].any():
                alive.append((queries, origin))
        self.origins = alive
        followed.select(keep)


def _gray(image: ImageArray, expected: tuple[int, ...] | None, frame: int) -> ImageArray:
    """Return the image as (H, W) uint8; ``expected`` is the size of the first frame."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise InputError(
            f"tracking: image {frame} has dtype {image.dtype} and shape {image.shape}; "
            "expected uint8 (H, W, 3) or (H, W)"
        )
    gray = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    if expected is not None and gray.shape != expected:
        raise InputError(f"tracking: image {frame} is {gray.shape}, the first one is {expected}")
    return np.ascontiguousarray(gray)


def _assemble(
    observations: _Observations,
    query_frame: Int32Array,
    num_frames: int,
    min_observations: int,
) -> Tracks:
    """Scatter per-frame observations into arrays, leaving out tracks seen too rarely."""
    seen = np.zeros(len(query_frame), np.int64)
    for _, tracks, _ in observations:
        seen[tracks] += 1
    keep = seen >= min(min_observations, num_frames)
    row = np.cumsum(keep) - 1
    uv = np.full((int(keep.sum()), num_frames, 2), np.nan, np.float32)
    visible = np.zeros(uv.shape[:2], np.bool_)
    for frame, tracks, points in observations:
        kept = keep[tracks]
        rows = row[tracks[kept]]
        uv[rows, frame] = points[kept]
        visible[rows, frame] = True
    return Tracks(uv, visible, query_frame[keep])
