r"""Static depth averaged over frames: what several views say about a pixel, where they agree.

A static pixel x of frame t with depth d is carried into frame s by the cameras, where it has depth z' and falls on
x'. There the depth map of frame s says D_s(x'). For small motion the two describe the same surface error, so that

    log d  <-  log d + mean over t and all agreeing s of  log(D_s(x') / z'),

with 0 for frame t itself. A frame agrees where ``|log(D_s(x') / z')|`` is below a bound: beyond it, x is occluded
there, on the border of a thing, or off. Errors that are independent between frames shrink with the root of their
number. Maps hold inverse depth: between pixels it is interpolated, which is exact on planes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.results.fusion.pixel_transfer import pixel_transfer

_ALIKE = 0.03
"""Log depths that differ by less are the same."""
_ITS_OWN = 1
"""Carried depth agrees with the frame that it comes from: so many more others must."""


class Averaged(NamedTuple):
    """Depth and how many agree on it, (H, W) each."""

    log_depth: Float32Array
    """NaN exactly where the frame's own is."""
    agreeing: Float32Array
    """Number of other frames that agree."""
    seeing: Float32Array
    """Number of other frames that have depth where the pixel falls in them."""
    alike: Float32Array
    """Number of those whose depth is the same to 3 %."""


def average_over_frames(
    inverse_depth: Float32Array,
    world_T_cam: FloatArray,
    others: Iterable[tuple[Float32Array, FloatArray, FloatArray]],
    intrinsics: FloatArray,
    max_disagreement: float,
    threads: int = 1,
) -> Averaged:
    """Average one frame's depth with that of other frames.

    Args:
        inverse_depth: (H, W) 1/m, NaN where depth is missing.
        world_T_cam: (4, 4) pose of the frame.
        others: Inverse depth (H, W), pose (4, 4) and intrinsics (4,) px of each other frame.
        intrinsics: (4,) px, of the frame.
        max_disagreement: Largest ``|log(D_s / z')|`` at which a frame agrees.
        threads: Of the C++ version; 0 takes all cores.
    """
    maps, turns, shifts = [], [], []
    for other, pose, camera in others:
        turn, shift = pixel_transfer(intrinsics, camera, np.asarray(np.linalg.solve(pose, world_T_cam)))
        maps.append(other)
        turns.append(turn)
        shifts.append(shift)
    where = np.array(turns).reshape(-1, 3, 3), np.array(shifts).reshape(-1, 3)
    agree, alike = float(np.exp(max_disagreement)), float(np.exp(_ALIKE))
    core, _ = find_extension()
    if core is None:
        product, *counts = compare_frames_numpy(inverse_depth, maps, *where, agree, alike)
    else:
        product, *counts = core.compare_frames(inverse_depth, maps, *where, agree=agree, alike=alike, threads=threads)
    return Averaged(np.log(product) / (counts[0] + 1) - np.log(inverse_depth), *counts)


def chosen_by_others(own: Averaged, carried: Averaged) -> Averaged:
    """Take depth that was carried into a frame where more of the other frames show the same than what is its own.

    Matching is wrong at borders that few views see, and blurs edges, which what is carried may have sharper.

    Args:
        own: What the frame is taken to show.
        carried: What frames beside it show of it.
    """
    more = carried.alike > own.alike + _ITS_OWN
    return Averaged(*(np.where(more, b, a) for a, b in zip(own, carried, strict=True)))


def compare_frames_numpy(
    inverse_depth: Float32Array,
    others: list[Float32Array],
    turns: FloatArray,
    shifts: FloatArray,
    agree: float,
    alike: float,
) -> Float32Array:
    """Compare a frame with others; ``cpp_factors/src/frame_comparison.cpp`` gives the same.

    Args:
        inverse_depth: (H, W) 1/m, NaN where depth is missing.
        others: N maps (Hn, Wn) alike.
        turns: (N, 3, 3) and
        shifts: (N, 3): pixel x at inverse depth rho is seen at ``turns x + rho shifts``, whose last entry is z over
            the first depth.
        agree: Largest ratio of two depths that agree.
        alike: And of two that are the same.

    Returns:
        (4, H, W): product of the ratios of those that agree; how many agree, have depth there, and are alike.
    """
    height, width = inverse_depth.shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    out = np.zeros((4, height, width), np.float32)
    out[0] = 1.0
    low, high, same = np.float32(1) / np.float32(agree), np.float32(agree), np.float32(alike)
    for other, turn, shift in zip(others, turns.astype(np.float32), shifts.astype(np.float32), strict=True):
        a, b, c = (turn[i, 0] * x + (turn[i, 1] * y + turn[i, 2]) + inverse_depth * shift[i] for i in range(3))
        bottom, right = other.shape[0] - 1, other.shape[1] - 1
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = a / c, b / c
            inside = (c > 0) & (u >= 0) & (v >= 0) & (u <= right) & (v <= bottom)
            u, v = np.where(inside, u, 0), np.where(inside, v, 0)
            i, j = u.astype(np.int64), v.astype(np.int64)
            next_i, next_j = np.minimum(i + 1, right), np.minimum(j + 1, bottom)
            p, q = u - i.astype(np.float32), v - j.astype(np.float32)
            top = other[j, i] + p * (other[j, next_i] - other[j, i])
            below = other[next_j, i] + p * (other[next_j, next_i] - other[next_j, i])
            ratio = inverse_depth / (c * (top + q * (below - top)))
            known = inside & (ratio > 0)
            agrees = known & (ratio > low) & (ratio < high)
            out[0] *= np.where(agrees, ratio, np.float32(1))
            out[1] += agrees
            out[2] += known
            out[3] += known & (ratio > np.float32(1) / same) & (ratio < same)
    return out
