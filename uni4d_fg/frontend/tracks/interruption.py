"""Whether something sweeps over the picture, so that hardly any track outlives it.

Somebody who walks past near the camera covers each part of the still scene for some frames. Every frame sees enough of
it, but what was seen before and what is seen after have few tracks in common, and the scale of the scene is handed on
by short ones: 9 % of it were lost over ten frames. Other videos of which tracks are short, as the camera turns fast,
have short tracks throughout.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray

_REACH = 5
"""Frames before and after."""
_FEW = 0.22
"""Part of the usual share of tracks that last: 0 and 0.17 in two clips in which somebody passes near by; 0.29 where a
box is carried past, 0.41 where the camera turns by 69 degrees in 56 frames, and at least 0.36 in sixty others."""


def is_interrupted(visible: BoolArray) -> bool:
    """Tell whether around some frame far fewer tracks than usual, of (K, T), are seen both before and after it."""
    apart = 2 * _REACH
    if visible.shape[1] <= 2 * apart:
        return False
    before, after = visible[:, :-apart], visible[:, apart:]
    fewer = np.minimum(np.count_nonzero(before, axis=0), np.count_nonzero(after, axis=0))
    lasting = np.count_nonzero(before & after, axis=0) / np.maximum(fewer, 1)
    return bool(lasting.min() < _FEW * np.median(lasting))
