"""The focal length from epipolar geometry alone, before any camera is known.

With the right intrinsics ``K`` a fundamental matrix becomes an essential one, ``E = K^T F K``, two of whose singular
values are equal and the third zero. Each pair of frames votes for the focal length at which its two are most alike;
where pairs agree the focal length is known well enough to start from. A camera that turns far is told best, just where
a scene that starts from another focal length bends until it fits.

Source: Mendonca and Cipolla, "A simple technique for self-calibration" (CVPR 1999), for one unknown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uni4d_fg.arrays import FloatArray

_FOCALS = np.geomspace(0.35, 2.5, 60)
"""Focal lengths that are tried, as parts of the longer side of the image: steps of 3.4 %."""
MIN_VOTES = 8
"""Pairs that tell a focal length, at least."""
AGREED = 1.35
"""Pairs agree if the upper quartile of their votes is at most this many times the lower one."""


class FocalGuess(NamedTuple):
    """A focal length to start from."""

    focal: float
    """px."""
    is_agreed: bool
    """Whether most pairs of frames agree on it."""


def focal_of_pairs(
    fundamental: FloatArray, image_size: tuple[int, int], principal_point: FloatArray
) -> FocalGuess | None:
    """Return the focal length that pairs of frames vote for, or None if too few of them tell one.

    Args:
        fundamental: (P, 3, 3) fundamental matrices in pixels, square ones, without distortion.
        image_size: (height, width), px.
        principal_point: (2,) px.
    """
    focal = _FOCALS * max(image_size)
    calibration = np.zeros((len(focal), 1, 3, 3))
    calibration[:, 0, [0, 1], [0, 1]] = focal[:, None]
    calibration[:, 0, :2, 2] = principal_point
    calibration[:, 0, 2, 2] = 1.0
    essential = calibration.swapaxes(2, 3) @ fundamental @ calibration
    values = np.linalg.svd(essential, compute_uv=False)  # (F, P, 3)
    unlike = 1.0 - values[..., 1] / np.maximum(values[..., 0], np.finfo(float).tiny)
    vote = np.argmin(unlike, axis=0)
    told = vote[(vote > 0) & (vote < len(focal) - 1)]  # at either end it is beyond, or not told at all
    if len(told) < MIN_VOTES:
        return None
    low, middle, high = np.quantile(focal[told], [0.25, 0.5, 0.75])
    return FocalGuess(float(middle), bool(high <= AGREED * low))


def least_of(x: FloatArray, y: FloatArray) -> float:
    """Return where the parabola through the least of evenly spaced values and those beside it is least."""
    at = int(np.clip(np.argmin(y), 1, len(y) - 2))
    bend = y[at - 1] - 2.0 * y[at] + y[at + 1]
    shift = 0.5 * (y[at - 1] - y[at + 1]) / bend if bend > 0.0 else 0.0
    return float(x[at] + np.clip(shift, -0.5, 0.5) * (x[1] - x[0]))
