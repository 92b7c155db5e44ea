"""Clouds in chunks that a browser can draw in part: near points together, any first part of them spread evenly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, IntArray
from uni4d_fg.geometry.nearest_points import NearestPoints

CHUNK_POINTS = 40_000
_MOST_CHUNKS = 32
"""Of a large cloud, whose chunks have more points: a browser takes time for each, however little of it is drawn."""
_SPACING_SAMPLES = 400
_TOUCHING = 1.6
"""Diameter over the spacing of points, at which a surface has no holes."""
_LEVELS = 1024
"""Positions are rounded to the chunk's half extent over this: half precision holds these exactly."""


@dataclass(frozen=True)
class Chunk:
    """Points that lie near each other, in units of the chunk."""

    rows: IntArray
    """(N,) which points of the cloud; every first part covers the chunk evenly."""
    center: FloatArray
    """(3,) middle of the chunk, meters."""
    radius: float
    """Half of its largest extent, meters: the unit of its points."""
    points: Float32Array
    """(N, 3) in [-1, 1], relative to the center."""
    diameter: float
    """Size of a point at which neighbors touch, meters."""


def chunks_of(points: FloatArray | Float32Array, limit: int | None = None) -> Iterator[Chunk]:
    """Split a cloud in halves, along the longest side, until no part has more than ``limit`` points.

    Args:
        points: (N, 3) world positions, meters, finite.
        limit: Most points of a chunk; :data:`CHUNK_POINTS`, more in a large cloud, if None.
    """
    limit = limit or max(CHUNK_POINTS, -(-len(points) // _MOST_CHUNKS))
    waiting = [np.arange(len(points))] if len(points) else []
    while waiting:
        rows = waiting.pop()
        part = points[rows]
        low, high = part.min(axis=0).astype(np.float64), part.max(axis=0).astype(np.float64)
        if len(rows) > limit:
            order = np.argpartition(part[:, int(np.argmax(high - low))], len(rows) // 2)
            waiting += [rows[order[len(rows) // 2 :]], rows[order[: len(rows) // 2]]]
            continue
        center, radius = 0.5 * (low + high), max(0.5 * float((high - low).max()), 1e-6)
        local = (part.astype(np.float64) - center) / radius
        order = even_order(local)
        rounded = np.rint(local[order] * _LEVELS) / _LEVELS
        yield Chunk(rows[order], center, radius, rounded.astype(np.float32), _TOUCHING * spacing_of(part))


def spacing_of(points: FloatArray | Float32Array) -> float:
    """Return the usual distance of a point (N, 3) to its neighbors on a surface, meters; 0.01 where there is one."""
    if len(points) < 5:
        return 0.01
    sample = points[:: max(1, len(points) // _SPACING_SAMPLES)]
    # The fourth neighbor, of four that a point on a grid has: the nearest one alone is that of points that coincide.
    distance, _ = NearestPoints(points).find(sample, 5)
    return max(float(np.median(distance[:, -1])), 1e-6)


def even_order(points: FloatArray) -> IntArray:
    """Return an order of points (N, 3) in [-1, 1] of which every first part covers all of them evenly.

    Along a space-filling curve (Morton's), neighbors in the curve are neighbors in space; taking its points in the
    order of their bit-reversed place (van der Corput's sequence) spreads them.
    """
    cells = np.clip((points + 1.0) * 512.0, 0, 1023).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    along = np.argsort(code, kind="stable")
    bits = max(int(len(points) - 1).bit_length(), 1)
    place = np.arange(2**bits)
    reversed_place = np.zeros_like(place)
    for bit in range(bits):
        reversed_place |= ((place >> bit) & 1) << (bits - 1 - bit)
    chosen: IntArray = along[reversed_place[reversed_place < len(points)]]
    return chosen
