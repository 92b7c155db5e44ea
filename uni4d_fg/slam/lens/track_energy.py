"""How badly a camera explains tracks: by the mean robust energy of what is seen of each."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray, IntArray

_LOST = 50.0
"""Errors, in sigmas, are cut here: what a camera does not explain counts as much."""
LOST_ENERGY = float(np.log1p(_LOST**2))
"""That of an observation that is lost."""


def robust_energies(error: FloatArray) -> FloatArray:
    """Return the energies (N,) of errors (N,), in sigmas: the logarithm of 1 plus the square of what is not cut."""
    return np.asarray(np.log1p(np.minimum(error, _LOST) ** 2))


def track_energies(error: FloatArray, row: IntArray, num_tracks: int) -> FloatArray:
    """Return the mean robust energy (K,) of each track; 0 of one that is not seen.

    Args:
        error: (N,) of observations, in sigmas; NaN makes that of the track NaN.
        row: (N,) their tracks.
        num_tracks: K.
    """
    count = np.bincount(row, minlength=num_tracks)
    return np.asarray(np.bincount(row, robust_energies(error), num_tracks) / np.maximum(count, 1))
