r"""Dense depth that agrees with the sparse points.

For every pixel x of an instance, with n(x) the nearest control points of that same instance in 3D,

    depth(x) = D(x) exp( sum_{i in n(x)} w_i s_i ),   s_i = log z(p_i) - log D(uv_i),   w_i ~ 1 / d_i^2

where d_i is the distance between the lifts of x and of uv_i with the raw cue D (Uni4D, densification; in
logarithms, and per instance for every instance). ``fusion.distance_power`` 1 gives w_i ~ 1 / d_i, as the paper's text
has it, and ``fusion.averaged_scale`` "linear" the mean of exp(s_i) instead of the exponential of the mean. A control
point's own noise would be copied into the dense map, so each s_i is first replaced by the median over its nearest
control points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import cv2
import numpy as np
from scipy.spatial import cKDTree

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.geometry.camera import unproject

_MIN_SQUARED_DISTANCE = 1e-8


@dataclass(frozen=True)
class ControlPoints:
    """Points of one frame whose depth is known besides the cue."""

    uv: FloatArray
    """(N, 2) px."""
    cue: FloatArray
    """(N,) depth cue at uv, m."""
    log_scale: FloatArray
    """(N,) log of the point's depth over the cue."""
    instance: Int32Array
    """(N,) 0 static, > 0 instance."""
    points: FloatArray
    """(N, 3) world, m."""
    share: FloatArray | None = None
    """(N,) part of its weight that each point has, 0 to 1; None gives all their whole weight."""


@dataclass(frozen=True)
class SomeControlPoints(Sequence[ControlPoints]):
    """Those of some frames, by the numbers of all."""

    start: int
    some: list[ControlPoints]
    num_frames: int

    @classmethod
    def of(cls, control: Sequence[ControlPoints], start: int, stop: int) -> SomeControlPoints:
        """Take those of frames ``start`` to ``stop - 1``, as far as there are any."""
        start, stop = max(start, 0), min(stop, len(control))
        return cls(start, [control[frame] for frame in range(start, stop)], len(control))

    def __len__(self) -> int:
        return self.num_frames

    @overload
    def __getitem__(self, frame: int) -> ControlPoints: ...
    @overload
    def __getitem__(self, frame: slice) -> list[ControlPoints]: ...
    def __getitem__(self, frame: int | slice) -> ControlPoints | list[ControlPoints]:
        """Return those of a frame. Raises IndexError where they were left out."""
        if isinstance(frame, slice):
            return [self[number] for number in range(*frame.indices(self.num_frames))]
        if not 0 <= frame - self.start < len(self.some):
            raise IndexError(f"control points of frame {frame} were left out")
        return self.some[frame - self.start]


def densify_frame(
    depth: Float32Array,
    mask: Int32Array,
    intrinsics: FloatArray,
    control: ControlPoints,
    frame_log_scale: float,
    depth_sigma: float,
    config: FusionConfig,
) -> Float32Array:
    """Correct one frame's depth cue.

    Args:
        depth: (H, W) cue, m, NaN where missing; zero, negative and infinite values count as missing.
        mask: (H, W) 0 static, > 0 instance.
        intrinsics: (4,) px.
        control: Control points of this frame.
        frame_log_scale: The frame's own log-scale: used where an instance has too few control points.
        depth_sigma: Standard deviation of the cue's log depth, from the static scene.
        config: Fusion.

    Returns:
        (H, W) float32 m, NaN exactly where the cue is missing.
    """
    height, width = depth.shape
    with np.errstate(invalid="ignore"):
        depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(np.nan))
    out = depth * np.float32(np.exp(frame_log_scale))
    nodes = _grid(depth, intrinsics, config.stride)
    limit = config.max_scale_sigmas * depth_sigma
    plausible = np.isfinite(control.log_scale) & (np.abs(control.log_scale - frame_log_scale) <= limit)
    for label in np.unique(mask).tolist():
        mine = np.flatnonzero(plausible & (control.instance == label))
        if len(mine) < config.min_control_points:
            continue
        anchors = unproject(intrinsics, control.uv[mine], control.cue[mine])
        scale = _smooth(anchors, control.log_scale[mine], config.smoothing)
        pixels = mask == label
        asked = np.where(_around(pixels, nodes.shape[:2])[..., None], nodes, np.nan)
        linear = config.averaged_scale == "linear"
        default = frame_log_scale
        if linear:
            scale, default = np.exp(scale), float(np.exp(frame_log_scale))
        field = _interpolate(asked, anchors, scale, default, config.neighbors, config.distance_power)
        dense = cv2.resize(field, (width, height), interpolation=cv2.INTER_LINEAR)
        out[pixels] = depth[pixels] * (dense[pixels] if linear else np.exp(dense[pixels]))
    return out


def _grid(depth: Float32Array, intrinsics: FloatArray, stride: int) -> FloatArray:
    """Lift the centers of stride x stride cells, (rows, columns, 3); NaN where a cell has no depth."""
    height, width = depth.shape
    rows, columns = -(-height // stride), -(-width // stride)
    # Centers as cv2.resize places them, so that its bilinear interpolation has no shift.
    v = (np.arange(rows) + 0.5) * height / rows - 0.5
    u = (np.arange(columns) + 0.5) * width / columns - 0.5
    uu, vv = np.meshgrid(u, v)
    sampled = depth[np.rint(vv).astype(np.int64), np.rint(uu).astype(np.int64)].astype(np.float64)
    result: FloatArray = unproject(intrinsics, np.stack([uu, vv], axis=-1), sampled)
    return result


def _around(pixels: BoolArray, shape: tuple[int, ...]) -> BoolArray:
    """Return the nodes (rows, columns) that the interpolation at some pixels (H, W) reads, and those beside them."""
    at = []
    for where, nodes, size in zip(np.nonzero(pixels), shape, pixels.shape, strict=True):
        at.append(np.clip(np.floor((where + 0.5) * nodes / size - 0.5), 0, nodes - 1).astype(np.int64))
    marked = np.zeros(shape, np.uint8)
    marked[tuple(at)] = 1
    # The node itself and the next one are read; rounding may take either for the first.
    return np.asarray(cv2.dilate(marked, np.ones((5, 5), np.uint8)) > 0)


def _smooth(anchors: FloatArray, scale: FloatArray, count: int) -> FloatArray:
    """Replace each scale by the median over its ``count`` nearest control points (itself included)."""
    k = min(count, len(anchors))
    if k < 2:
        return scale
    _, index = cKDTree(anchors).query(anchors, k=k)
    result: FloatArray = np.median(scale[index], axis=1)
    return result


def _interpolate(
    nodes: FloatArray, anchors: FloatArray, scale: FloatArray, default: float, count: int, power: int
) -> Float32Array:
    """Interpolate scales, or their logarithms, at nodes (rows, columns, 3) by inverse distance, (rows, columns).

    Args:
        nodes: (rows, columns, 3) m; those that are NaN have the default.
        anchors: (N, 3) control points, m.
        scale: (N,) of the control points.
        default: Where nothing is known.
        count: Nearest control points of a node, at most.
        power: Of the distance in the weights, 1 or 2.
    """
    field = np.full(nodes.shape[:2], default)
    known = np.isfinite(nodes).all(axis=-1)
    k = min(count, len(anchors))
    distance, index = cKDTree(anchors).query(nodes[known], k=k)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    weight = 1.0 / np.maximum(distance**2, _MIN_SQUARED_DISTANCE)
    if power == 1:
        weight = np.sqrt(weight)
    field[known] = np.sum(weight * scale[index], axis=1) / np.sum(weight, axis=1)
    return field.astype(np.float32)
