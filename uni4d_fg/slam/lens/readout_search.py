"""Search for the time of readout at which an energy is least: near its minimum that is close to a parabola."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

FIRST = 0.3
"""The first readout that is tried, to either side."""
_OUTWARD = 2.2
"""Factor to the next where one is the best."""
LONGEST = 1.0
"""No image is read longer than until the next."""
BELIEVED = 0.95
"""Nor is one read for as long as this: sensors pause between two images."""
_PARABOLAS, _NEAR = 3, 0.02
"""Readouts that are nearer than this to one that was tried are not."""


def least_readout(energy: Callable[[float], float]) -> float:
    """Return the readout with the least energy, as a part of the time between two frames; 0 is none.

    Args:
        energy: Of a readout, negative where the last row is read first. It is asked once for each.
    """
    tried = {part: energy(part) for part in (0.0, -FIRST, FIRST)}
    while True:  # the best so far is to lie between others: outward, as far as a shutter goes
        best = min(tried, key=tried.__getitem__)
        if best not in (min(tried), max(tried)) or abs(best) >= LONGEST:
            break
        farther = float(np.clip(_OUTWARD * best, -LONGEST, LONGEST))
        tried[farther] = energy(farther)
    if abs(best) >= LONGEST:  # the least may well lie before it, and a parabola through none beyond is a poor one
        inner = 0.5 * (best + min((part for part in tried if part != best), key=lambda part: abs(part - best)))
        tried[inner] = energy(inner)
    for _ in range(_PARABOLAS):
        # Of the best and those beside it: farther ones are no parabola's.
        at = sorted(tried)
        middle = int(np.clip(at.index(min(tried, key=tried.__getitem__)), 1, len(at) - 2))
        beside = at[middle - 1 : middle + 2]
        curve = np.polyfit(beside, [tried[part] for part in beside], 2)
        if not curve[0] > 0.0:
            break
        lowest = float(np.clip(-0.5 * curve[1] / curve[0], -LONGEST, LONGEST))
        if min(abs(lowest - part) for part in tried) < _NEAR:
            break
        tried[lowest] = energy(lowest)
    return min(tried, key=tried.__getitem__)
