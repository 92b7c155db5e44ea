"""The built-in tracker: grids of points followed by pyramidal Lucas-Kanade, forwards and backwards in time.

A grid of query points is started in frames 0, ``query_interval``, 2 ``query_interval``, ... Two sweeps over
the video follow them: one forwards, in which every grid joins as the sweep passes its frame, and one
backwards. Each step moves all live points of all grids at once, so that a video costs two optical-flow calls
per pair of frames and sweep, however many grids there are, and only the two images of the step are held.

A point is lost, and never found again in that sweep, when Lucas-Kanade gives up on it (no texture), when
tracking it back misses where it came from, when its window looks different, or when it leaves the image.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray, IntArray
from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.sequence.model import FrameSource
from uni4d_fg.tracks.model import Tracks

Progress = Callable[[int, int], None]
"""Called with the number of steps done and the number of steps in all."""
ShouldStop = Callable[[], bool]
"""Asked between steps; True ends the work with :class:`~uni4d_fg.errors.Cancelled`."""

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
        images: T images (H, W, 3) uint8 RGB, or (H, W) uint8 grey; each is read twice, in order.
        config: Grid, window and checks.
        progress: Told the steps done and to do after every step.
        should_stop: Asked before every step.

    Returns:
        The tracks seen in at least ``min_observations`` frames (or in all, if the video is shorter).

    Raises:
        InputError: If the images differ in size or are not uint8.
        Cancelled: If ``should_stop`` said so.
    """
    num_frames = len(images)
    if num_frames == 0:
        raise InputError("tracking: the sequence has no images")
    image_size = _grey(images[0], None, 0).shape
    grid = query_grid((image_size[0], image_size[1]), config)
    query_frames = list(range(0, num_frames, config.query_interval))
    first_track = {frame: i * len(grid) for i, frame in enumerate(query_frames)}

    observations: _Observations = []
    for frame in query_frames:
        observations.append((frame, first_track[frame] + np.arange(len(grid)), grid))
    steps_done, steps = 0, 2 * (num_frames - 1)
    for order in (range(num_frames), range(num_frames - 1, -1, -1)):
        live = np.zeros(0, np.int64)
        points = np.zeros((0, 2), np.float32)
        previous: ImageArray | None = None
        for frame in order:
            if should_stop is not None and should_stop():
                raise Cancelled(f"tracking stopped at step {steps_done} of {steps}")
            image = _grey(images[frame], image_size, frame)
            if previous is not None:
                kept, points = step(previous, image, points, config)
                live = live[kept]
                observations.append((frame, live, points))
                steps_done += 1
                if progress is not None:
                    progress(steps_done, steps)
            if frame in first_track:
                live = np.concatenate((live, first_track[frame] + np.arange(len(grid))))
                points = np.concatenate((points, grid))
            previous = image
    query_frame = np.repeat(np.asarray(query_frames, np.int32), len(grid))
    return _assemble(observations, query_frame, num_frames, config.min_observations)


def step(
    source: ImageArray, target: ImageArray, points: Float32Array, config: TrackingConfig
) -> tuple[BoolArray, Float32Array]:
    """Move points from one grey image to the next.

    Args:
        source: (H, W) uint8, the image in which the points are known.
        target: (H, W) uint8.
        points: (N, 2) px in ``source``.
        config: Window and checks.

    Returns:
        kept: (N,) True for the M points that passed every check.
        moved: (M, 2) their pixels in ``target``.
    """
    kept = np.zeros(len(points), np.bool_)
    if len(points) == 0:
        return kept, points
    moved, found, difference = _flow(source, target, points, config)
    height, width = target.shape
    border = config.border_px
    inside = (moved >= border).all(axis=1) & (moved <= (width - 1 - border, height - 1 - border)).all(axis=1)
    candidate = np.flatnonzero(found & inside & (difference <= config.max_patch_error))
    if len(candidate) == 0:
        return kept, moved[:0]
    back, found_back, _ = _flow(target, source, moved[candidate], config)
    miss = np.linalg.norm(back - points[candidate], axis=1)
    survivors = candidate[found_back & (miss <= config.forward_backward_px)]
    kept[survivors] = True
    return kept, moved[survivors]


def _flow(
    source: ImageArray, target: ImageArray, points: Float32Array, config: TrackingConfig
) -> tuple[Float32Array, BoolArray, Float32Array]:
    """Return moved points (N, 2), found (N,) and the mean absolute grey-level difference (N,)."""
    moved, status, difference = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        np.ascontiguousarray(points),
        None,
        winSize=(config.window_px, config.window_px),
        maxLevel=config.pyramid_levels,
        criteria=(
            cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT,
            config.max_iterations,
            config.convergence_px,
        ),
        minEigThreshold=config.min_texture,
    )
    return moved.reshape(-1, 2), status.ravel() > 0, difference.ravel()


def _grey(image: ImageArray, expected: tuple[int, ...] | None, frame: int) -> ImageArray:
    """Return the image as (H, W) uint8; ``expected`` is the size of the first frame."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise InputError(
            f"tracking: image {frame} has dtype {image.dtype} and shape {image.shape}; "
            "expected uint8 (H, W, 3) or (H, W)"
        )
    grey = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    if expected is not None and grey.shape != expected:
        raise InputError(f"tracking: image {frame} is {grey.shape}, the first one is {expected}")
    return np.ascontiguousarray(grey)


def _assemble(
    observations: _Observations,
    query_frame: npt.NDArray[np.int32],
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
