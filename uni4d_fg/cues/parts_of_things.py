"""Parts of one thing that masks tell apart: what ends on another moving thing stands where that does.

Somebody whose trousers differ from the shirt, or who keeps the legs still for a while, is masked in parts. The ground
below a part that ends at the waist is where nobody stands. So a thing that for most of what is seen of it ends on, or
a little above, another one has the place of the lowest of those that follow each other downward. In a crowd the one
that is lower in the image is the nearer one, and what it hides of the others stands where it does, or farther away.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from uni4d_fg.arrays import Int32Array, IntArray
from uni4d_fg.cues.interpolated_depth import lowest_part

_REACH = 0.5
"""How far below a thing another one may begin that it is part of, as a part of its height: what moves little between
them has no mask."""
_MOST = 0.5
"""A thing rests on another one if that is so for more than this part of its lowest columns, and of its area over all
frames."""


def things_below(mask: Int32Array, contact_fraction: float) -> dict[int, int]:
    """Return what begins right below each thing of a mask, by id; a thing with the static scene below it is left out.

    Args:
        mask: (H, W) 0 static, > 0 ids.
        contact_fraction: Part of a thing's height that is its lowest part.
    """
    out: dict[int, int] = {}
    for label in np.unique(mask[mask > 0]).tolist():
        mine = mask == label
        line, columns = lowest_part(mine, contact_fraction)
        reach = int(np.ceil(_REACH * np.count_nonzero(mine.any(axis=1))))
        votes = Counter[int]()
        for row, column in zip(line.tolist(), columns.tolist(), strict=True):
            follows = mask[row + 1 : row + 1 + reach, column]
            others = follows[(follows > 0) & (follows != label)]
            votes.update(others[:1].tolist())
        if votes.total() > _MOST * len(columns):
            out[label] = votes.most_common(1)[0][0]
    return out


def feet_of(below: Sequence[Mapping[int, int]], area: Mapping[int, IntArray]) -> tuple[dict[int, int], ...]:
    """Return for each frame the thing that each thing stands by (by id): itself, or the lowest that follows downward.

    Args:
        below: T: what is below each thing, see :func:`things_below`.
        area: By id: (T,) area of each thing, px. Frames count by it.
    """
    resting = {label: sum(size[t] for t, here in enumerate(below) if label in here) for label, size in area.items()}
    parts = {label for label, size in area.items() if resting[label] > _MOST * size.sum()}
    return tuple(
        {label: _foot(label, here, parts) for label, size in area.items() if size[t]} for t, here in enumerate(below)
    )


def _foot(label: int, below: Mapping[int, int], parts: set[int]) -> int:
    passed = {label}
    while label in parts and label in below and below[label] not in passed:
        label = below[label]
        passed.add(label)
    return label
