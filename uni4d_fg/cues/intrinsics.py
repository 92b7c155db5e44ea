"""One camera for a video from what a network says of every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.robust import robust_sigma

_TUKEY = 4.685
"""Sigmas beyond which a value does not count: 95 % efficient on normal noise."""
_ROUNDS = 20
_SMALL = 1e-9
_SPREAD_TO_WARN = 0.05


@dataclass(frozen=True)
class SharedIntrinsics:
    """The camera, and how well the frames agree on it."""

    intrinsics: FloatArray
    """(4,) fx, fy, cx, cy, px."""
    spread: float
    """Robust relative standard deviation of the frames' focal lengths."""
    used: int
    """Frames that said something."""

    def warnings(self) -> list[str]:
        """Say what is to be distrusted, if anything."""
        if self.spread <= _SPREAD_TO_WARN:
            return []
        return [
            f"the depth network's focal lengths differ by {100 * self.spread:.0f} % from frame to frame: "
            "give a calibration (K.npy) if there is one"
        ]


def shared_intrinsics(per_frame: FloatArray) -> SharedIntrinsics | None:
    """Return the robust mean of the cameras of all frames.

    Focal lengths are averaged as logarithms and all four numbers with Tukey's weights around their median, so
    that frames in which the network fails do not count.

    Args:
        per_frame: (T, 4) fx, fy, cx, cy, px; NaN rows where nothing is known.

    Returns:
        The camera; None if no frame says anything.
    """
    known = per_frame[np.isfinite(per_frame).all(axis=1)]
    if len(known) == 0:
        return None
    values = np.concatenate((np.log(known[:, :2]), known[:, 2:]), axis=1)
    mean, sigma = zip(*(robust_mean(column) for column in values.T), strict=True)
    intrinsics = np.array([np.exp(mean[0]), np.exp(mean[1]), mean[2], mean[3]])
    return SharedIntrinsics(intrinsics, max(sigma[:2]), len(known))


def robust_mean(values: FloatArray) -> tuple[float, float]:
    """Return the mean of (N,) values with Tukey's weights, and their robust standard deviation."""
    center = float(np.median(values))
    sigma = robust_sigma(values - center)
    if sigma < _SMALL:
        return center, sigma
    for _ in range(_ROUNDS):
        ratio = (values - center) / (_TUKEY * sigma)
        weight = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
        previous, center = center, float((weight * values).sum() / weight.sum())
        if abs(center - previous) < _SMALL * max(1.0, abs(center)):
            break
    return center, sigma
