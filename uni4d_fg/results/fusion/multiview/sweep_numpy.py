"""The plane sweep of ``cpp_factors/src/plane_sweep.cpp`` and ``plane_matching.cpp`` in NumPy: what it must give.

It runs where the extension is not installed. For every plane, each other image is warped onto the reference and
compared by normalized cross-correlation over a window, and by differences of gray values over a smaller one, which keep
edges; of more than two images the two that match best count, so that a pixel which some do not see is still found.
Costs are whole numbers up to 255, weighted means of (1 - correlation) 127.5 and of the difference over its largest one;
128 where nothing is known. Semi-global matching sums them along eight paths (Hirschmueller 2008), with penalties for a
change of plane that are lower across edges of the image.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, FloatArray, Int32Array
from uni4d_fg.results.fusion.multiview.warp_numpy import warp

_UNKNOWN = 128
_NARROW = 1
"""Half side of the window over which gray values are compared themselves, px."""
_LEAST_SMALL_STEP = np.float32(6)
"""Across an edge of the image a change by one plane is not free."""


def sweep_numpy(
    image: Float32Array,
    others: Float32Array,
    turns: FloatArray,
    shifts: FloatArray,
    planes: FloatArray,
    *,
    radius: int,
    noise: float,
    difference_share: float,
    largest_difference: float,
    small_step: int,
    large_step: int,
    edge_contrast: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Sweep an image.

    Args:
        image: (h, w), NaN where it is not to be matched.
        others: (V, h, w) alike.
        turns: (V, 3, 3) and
        shifts: (V, 3): pixel x at inverse depth rho is seen at ``turns x + rho shifts``.
        planes: (D,) inverse depths.
        radius: Half side of the window, px.
        noise: Standard deviation of the images' noise.
        difference_share: Part of the cost that differences of gray values are.
        largest_difference: Larger ones are all alike.
        small_step: Penalty of a change by one plane where the image is flat.
        large_step: Penalty of a larger one, alike.
        edge_contrast: Difference between pixels that halves them.

    Returns:
        The best plane as a number between them, its aggregated cost, that of the best plane elsewhere, and the
        matching cost, (h, w) each.
    """
    costs = _matching_costs(
        image.astype(np.float32), others.astype(np.float32), turns, shifts, planes, radius, noise,
        np.float32(difference_share), np.float32(largest_difference),
    )  # fmt: skip
    total = np.zeros(costs.shape, np.int32)
    for step in ((0, 1), (1, -1), (1, 0), (1, 1)):
        for sign in (1, -1):
            total += _path_costs(costs, image, (sign * step[0], sign * step[1]), small_step, large_step, edge_contrast)
    return _choose(total, costs)


def _matching_costs(
    image: Float32Array, others: Float32Array, turns: FloatArray, shifts: FloatArray, planes: FloatArray,
    radius: int, noise: float, difference_share: np.float32, largest_difference: np.float32,
) -> Int32Array:  # fmt: skip
    """Return costs (h, w, D)."""
    height, width = image.shape
    reference = np.where(np.isfinite(image), image, np.float32(0))
    inner = np.zeros(image.shape, bool)
    inner[radius : height - radius, radius : width - radius] = True
    known = inner & np.isfinite(image)
    mean = _window_mean(reference, radius)
    variance = np.maximum(_window_mean(reference * reference, radius) - mean * mean, 0)
    noise2 = np.float32(noise) ** 2
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    costs = np.empty((height, width, len(planes)), np.int32)
    for index, rho in enumerate(planes):
        found = []
        for other, turn, shift in zip(others, turns.astype(np.float32), shifts.astype(np.float32), strict=True):
            warped, seen = warp(other, turn, shift, u, v, np.float32(rho))
            there = _window_mean(warped, radius)
            spread = np.maximum(_window_mean(warped * warped, radius) - there * there, 0)
            both = _window_mean(warped * reference, radius) - there * mean
            zncc = both / np.sqrt((variance + noise2) * (spread + noise2))
            unlike = np.clip((1 - zncc) * np.float32(127.5), 0, 255)
            differing = _window_mean(np.minimum(np.abs(warped - reference), largest_difference), _NARROW)
            differing *= np.float32(255) / largest_difference
            cost = ((1 - difference_share) * unlike + difference_share * differing + np.float32(0.5)).astype(np.int32)
            found.append(np.where(known & seen, cost, _UNKNOWN))
        ordered = np.sort(np.stack(found), axis=0)
        costs[..., index] = (ordered[0] + ordered[1] + 1) // 2 if len(found) > 2 else ordered[0]
    return costs


def _window_mean(values: Float32Array, radius: int) -> Float32Array:
    """Return the mean over windows; beyond the image there is 0."""
    padded = np.pad(values, radius)
    height, width = values.shape
    side = 2 * radius + 1
    rows = np.stack([padded[:, k : k + width] for k in range(side)]).sum(axis=0)
    total = np.stack([rows[k : k + height] for k in range(side)]).sum(axis=0)
    return np.asarray(total * np.float32(1 / side**2), np.float32)


def _path_costs(
    costs: Int32Array, image: Float32Array, step: tuple[int, int], small: int, large: int, contrast: float
) -> Int32Array:
    """Return the costs summed along paths that come from ``step`` (rows, columns) before, (h, w, D)."""
    height, width, _ = costs.shape
    dy, dx = step
    before = np.roll(image, (dy, dx), axis=(0, 1))
    difference = np.nan_to_num(np.abs(image - before))
    flatness = np.float32(1) / (1 + difference / np.float32(contrast))
    least = np.maximum(np.float32(small) * flatness, min(np.float32(small), _LEAST_SMALL_STEP))
    jump = np.maximum(np.float32(large) * flatness, least).astype(np.int32)
    slide = least.astype(np.int32)
    out = costs.copy()
    if dy == 0:
        for x in range(width)[:: 1 if dx > 0 else -1]:
            if 0 <= x - dx < width:
                out[:, x] += _least_step(out[:, x - dx], slide[:, x], jump[:, x])
        return out
    for y in range(height)[:: 1 if dy > 0 else -1]:
        if 0 <= y - dy < height:
            here = slice(max(dx, 0), width + min(dx, 0))
            there = slice(max(-dx, 0), width + min(-dx, 0))
            out[y, here] += _least_step(out[y - dy, there], slide[y, here], jump[y, here])
    return out


def _least_step(previous: Int32Array, small: Int32Array, large: Int32Array) -> npt.NDArray[np.int32]:
    """Return the least cost of coming from the previous pixels (N, D), less their least, at penalties (N,)."""
    least = previous.min(axis=1, keepdims=True)
    best = np.minimum(previous, least + large[:, None])
    best[:, 1:] = np.minimum(best[:, 1:], previous[:, :-1] + small[:, None])
    best[:, :-1] = np.minimum(best[:, :-1], previous[:, 1:] + small[:, None])
    return np.asarray(best - least, np.int32)


def _choose(total: Int32Array, costs: Int32Array) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    depth = total.shape[2]
    best = total.argmin(axis=2)
    least = total.min(axis=2)
    beside = np.abs(np.arange(depth) - best[..., None]) <= 2
    rival = np.where(beside, np.iinfo(np.int32).max, total).min(axis=2)
    rival = np.where(rival == np.iinfo(np.int32).max, least, rival)

    def at(index: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
        return np.take_along_axis(total, np.clip(index, 0, depth - 1)[..., None], axis=2)[..., 0]

    before, after = at(best - 1), at(best + 1)
    bend = before + after - 2 * least
    refinable = (best > 0) & (best < depth - 1) & (bend > 0)
    shift = np.where(refinable, 0.5 * (before - after) / np.where(bend > 0, bend, 1), 0.0)
    matching = np.take_along_axis(costs, best[..., None], axis=2)[..., 0]
    return best + shift, least.astype(np.float64), rival.astype(np.float64), matching.astype(np.float64)
