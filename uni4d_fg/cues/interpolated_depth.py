"""Dense depth of one frame from sparse points, and of what moves from where it stands.

Inverse depth is linear in the image over any plane, so it is what is interpolated: linearly over the Delaunay
triangles of the static points in the frame, and taken from the nearest point outside their hull, but no farther than
the ground. A moving thing has no static points of its own. It is given one depth per frame: that of the static surface
at the lowest part of its mask, where it may touch the ground, or a smaller one (``moving_things.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from uni4d_fg.config.geometric_depth import GeometricDepthConfig
from uni4d_fg.cues.ground_plane import Ground
from uni4d_fg.cues.triangle_grid import linear_on_grid
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.frames import LazyFrames
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.optim.threads import thread_count, workers_in_order
from uni4d_fg.progress import Reporter

NEAREST_SHARE = 0.75
"""Of the inverse depths at which a thing seems to stand, the quantile that is taken: masks lose feet, which makes it
farther, more often than they reach beyond."""
_BEYOND = 1.05
"""What is farther than the ground by more than this is on it."""


@dataclass(frozen=True)
class SparseInverseDepth:
    """Static points in one frame."""

    uv: FloatArray
    """(N, 2) px."""
    inverse_depth: FloatArray
    """(N,) positive."""


@dataclass(frozen=True)
class InterpolatedDepths(LazyFrames[Float32Array]):
    """T depth maps, each interpolated when it is asked for."""

    points: tuple[SparseInverseDepth, ...]
    """T."""
    image_size: tuple[int, int]
    """(height, width), px."""
    config: GeometricDepthConfig
    masks: FrameSource[Int32Array] | None = None
    standing: tuple[Mapping[int, float], ...] = field(default=())
    """T: inverse depth of every moving thing in a frame, by mask id."""
    grids: tuple[Float32Array, ...] = field(default=())
    """T: what :func:`interpolate` gives, where that was asked for before; else it is computed with each map."""
    ground: Ground | None = None
    """Nothing static is farther."""

    def __len__(self) -> int:
        return len(self.points)

    def where(self, frame: int) -> str:
        """Return the frame number; there is no file."""
        return f"interpolated depth [frame {frame}]"

    def static(self, frame: int) -> Float32Array:
        """Return the inverse depth (H, W) of the static scene, also behind what moves."""
        return enlarged(self.grids[frame] if self.grids else self.grid(frame), self.image_size)

    def grid(self, frame: int) -> Float32Array:
        """Return the static inverse depth of a frame on the grid of ``config.stride``: points, and the ground."""
        grid = interpolate(self.points[frame], self.image_size, self.config.stride)
        if self.ground is None:
            return grid
        uv = grid_pixels(grid.shape, self.image_size)
        ground = self.ground.inverse_depth(uv, frame).reshape(grid.shape).astype(np.float32)
        return np.where(ground > _BEYOND * grid, ground, grid)

    def all_grids(self, reporter: Reporter, should_stop: Callable[[], bool]) -> Iterator[Float32Array]:
        """Yield :meth:`grid` of every frame, in their order, made on all threads.

        Args:
            reporter: Told the frames that the caller is done with.
            should_stop: Polled before every frame.

        Raises:
            Cancelled: If ``should_stop`` turned true.
        """
        with workers_in_order(thread_count()) as mapped:
            for frame, grid in enumerate(mapped(self.grid, list(range(len(self))))):
                if should_stop():
                    raise Cancelled("depth from motion stopped")
                yield grid
                reporter.advance(frame + 1)

    def _read(self, frame: int) -> Float32Array:
        inverse = self.static(frame)
        if self.masks is not None:
            mask = self.masks[frame]
            for label, value in self.standing[frame].items():
                inverse[mask == label] = value
        return (1.0 / inverse).astype(np.float32)


@dataclass(frozen=True)
class GridDepths(LazyFrames[Float32Array]):
    """T depth maps of a static scene, each enlarged when it is asked for."""

    grids: tuple[Float32Array, ...]
    """T: inverse depth as :func:`interpolate` gives it."""
    image_size: tuple[int, int]
    """(height, width), px."""
    name: str
    """What tells it from other depth of the same images."""

    def __len__(self) -> int:
        return len(self.grids)

    def where(self, frame: int) -> str:
        """Return the frame number; there is no file of its own."""
        return f"interpolated depth [frame {frame}]"

    def _read(self, frame: int) -> Float32Array:
        return (1.0 / enlarged(self.grids[frame], self.image_size)).astype(np.float32)


def interpolate(points: SparseInverseDepth, image_size: tuple[int, int], stride: int) -> Float32Array:
    """Interpolate inverse depth over an image: linearly over triangles, and from the nearest point outside of them.

    Args:
        points: At least one point.
        image_size: (height, width), px.
        stride: Spacing of the grid on which it is computed; :func:`enlarged` fills what is between.

    Returns:
        (rows, columns) of the grid, positive.
    """
    height, width = image_size
    rows, columns = -(-height // stride), -(-width // stride)
    scale = np.array([columns / width, rows / height])
    places = (points.uv + 0.5) * scale - 0.5
    grid = linear_on_grid(places, points.inverse_depth, (rows, columns))
    empty = ~np.isfinite(grid)
    if empty.any():
        uv = grid_pixels((rows, columns), image_size)[empty.ravel()]
        grid[empty] = points.inverse_depth[cKDTree(points.uv).query(uv)[1]]
    return grid.astype(np.float32)


def grid_pixels(shape: tuple[int, ...], image_size: tuple[int, int]) -> FloatArray:
    """Return where the nodes of a grid (rows, columns) are in an image (height, width), (rows * columns, 2) px.

    Centers are as cv2.resize places them, so that its bilinear interpolation has no shift.
    """
    row, column = np.mgrid[: shape[0], : shape[1]]
    scale = np.array([shape[1] / image_size[1], shape[0] / image_size[0]])
    return np.asarray((np.stack((column.ravel(), row.ravel()), axis=1) + 0.5) / scale - 0.5)


def enlarged(grid: Float32Array, image_size: tuple[int, int]) -> Float32Array:
    """Return what :func:`interpolate` gives as (H, W), bilinearly; ``image_size`` is (height, width)."""
    height, width = image_size
    return np.asarray(cv2.resize(grid, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def supported(uv: FloatArray, inverse_depth: FloatArray, config: GeometricDepthConfig) -> BoolArray:
    """Return which points (N,) have a few of their nearest neighbors in the image at a similar depth.

    A wrong point stands alone; beside a depth edge there are neighbors on either side.
    """
    if len(uv) <= config.support_neighbors:
        return np.ones(len(uv), dtype=bool)
    _, index = cKDTree(uv).query(uv, k=config.support_neighbors + 1)
    ratio = inverse_depth[index[:, 1:]] / inverse_depth[:, None]
    like = (ratio < config.support_ratio) & (ratio > 1.0 / config.support_ratio)
    result: BoolArray = np.count_nonzero(like, axis=1) >= config.min_supporters
    return result


def ground_contact(mask: Int32Array, inverse: Float32Array, config: GeometricDepthConfig) -> dict[int, float]:
    """Return the inverse depth of the static surface just below every thing of a mask, by id.

    Args:
        mask: (H, W) 0 static, > 0 ids.
        inverse: (H, W) inverse depth of the static surface of the frame.
        config: ``contact_fraction``.
    """
    out: dict[int, float] = {}
    for label in np.unique(mask[mask > 0]).tolist():
        line, columns = lowest_part(mask == label, config.contact_fraction)
        out[int(label)] = float(np.median(inverse[line, columns]))
    return out


def lowest_part(mine: BoolArray, fraction: float) -> tuple[IntArray, IntArray]:
    """Return the lowest pixel (lines, columns) of each column of the lowest part of a thing.

    Args:
        mine: (H, W) where the thing is.
        fraction: Of its height.
    """
    lines = np.flatnonzero(mine.any(axis=1))
    height = int(np.ceil(fraction * (lines[-1] - lines[0] + 1)))
    lowest = mine[lines[-1] - height + 1 : lines[-1] + 1]
    columns = np.flatnonzero(lowest.any(axis=0))
    return lines[-1] - np.argmax(lowest[::-1, columns], axis=0), columns


def smooth_over_time(standing: list[dict[int, float]], window: int) -> tuple[dict[int, float], ...]:
    """Replace each thing's value by its upper quartile over ``window`` frames: masks lose feet from frame to frame."""
    half = window // 2
    return tuple(
        {
            label: float(
                np.quantile(
                    [other[label] for other in standing[max(0, t - half) : t + half + 1] if label in other],
                    NEAREST_SHARE,
                    method="lower",
                )
            )
            for label in here
        }
        for t, here in enumerate(standing)
    )
