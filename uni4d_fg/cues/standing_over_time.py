"""Where a thing stands in every frame, from where its masks end and how its apparent size changes.

Masks end where a thing stands, or higher: they lose feet. What is left of the inverse depth there, once its apparent
size is taken off, is the same in all frames for a thing whose size is known. But sizes are sums of small changes, which
go astray, most of all where it turns. Its logarithm ``d`` is therefore a random walk,

    min  sum_t rho(y_t - d_t) + sum_t (d_{t+1} - d_t)^2 / (2 sigma^2)

of what is seen, ``y``, with the check function ``rho`` of a quantile (Koenker, Ng and Portnoy, "Quantile smoothing
splines", Biometrika 1994): of a walk that does not walk it is the upper quartile. It is solved by least squares that
are weighted anew (Schlossmacher, JASA 1973).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.cues.interpolated_depth import NEAREST_SHARE

_WALK = 0.005
"""Standard deviation of a step from one frame to the next."""
_NEARER = 0.1
"""Mean of how much nearer than the thing a mask ends, ..."""
_FARTHER = _NEARER * NEAREST_SHARE / (1 - NEAREST_SHARE)
"""... and farther: of a walk that does not walk that quantile is left."""
_EXACT = 1e-3
"""What is seen so closely counts no more than this."""
_ROUNDS, _STAYS = 100, 1e-5


def standing_over_time(log_inverse: FloatArray, is_bound: BoolArray) -> FloatArray:
    """Return the log inverse depth of a thing (T,), its apparent size taken off.

    Args:
        log_inverse: (T,) where its masks end, the apparent size taken off.
        is_bound: (T,) the image cuts it off there, so that it is nearer by any factor; not in all frames.
    """
    found = np.full(len(log_inverse), float(np.quantile(log_inverse[~is_bound], NEAREST_SHARE)))
    if len(found) == 1:
        return found
    pull = _WALK**-2
    system = np.zeros((2, len(found)))
    system[0, 1:] = -pull
    for _ in range(_ROUNDS):
        beyond = log_inverse - found
        slope = np.where(beyond > 0, 1 / _NEARER, np.where(is_bound, 0.0, 1 / _FARTHER))
        weight = slope / np.maximum(np.abs(beyond), _EXACT)
        system[1] = weight
        system[1, :-1] += pull
        system[1, 1:] += pull
        before, found = found, np.asarray(solveh_banded(system, weight * log_inverse))
        if np.abs(found - before).max() < _STAYS:
            break
    return found
