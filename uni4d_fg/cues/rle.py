"""Masks as runs of pixels, the way COCO's tools write them: plain lists of counts, and their compressed strings.

The runs go down the columns, from left to right, and alternate between outside and inside, beginning outside. The
string holds each count, from the third on as the difference to the one two before it, in groups of five bits with
the lowest first: ``48 + bits``, with 32 added where more follow; bit 16 of the last group is the sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, IntArray
from uni4d_fg.errors import InputError

_MAX_GROUPS = 7


def decode_rle(segmentation: Any, where: str) -> BoolArray:
    """Decode one mask.

    Args:
        segmentation: ``{"size": [height, width], "counts": [...] or "..."}``.
        where: What to call it in messages.

    Returns:
        (H, W) bool.

    Raises:
        InputError: If it is not of that form, or the runs do not fill the size exactly.
    """
    if isinstance(segmentation, list):
        raise InputError(f"{where}: is a polygon; write the mask as run lengths (RLE)")
    size = segmentation.get("size") if isinstance(segmentation, dict) else None
    counts = segmentation.get("counts") if isinstance(segmentation, dict) else None
    if not (isinstance(size, Sequence) and len(size) == 2 and all(isinstance(n, int) and n > 0 for n in size)):
        raise InputError(f"{where}: is no run-length mask: it needs 'size' [height, width] and 'counts'")
    height, width = int(size[0]), int(size[1])
    if isinstance(counts, (str, bytes)):
        runs = decode_counts(counts, where)
    elif isinstance(counts, Sequence) and all(isinstance(n, int) for n in counts):
        runs = np.array(counts, np.int64)
    else:
        raise InputError(f"{where}: 'counts' must be a list of whole numbers or a string")
    # A damaged file must not ask for memory before the sum is known to be right.
    if (runs < 0).any() or int(runs.sum()) != height * width:
        raise InputError(f"{where}: the runs do not fill {height} x {width} pixels; write the file again")
    inside = np.arange(len(runs)) % 2 == 1
    filled: BoolArray = np.repeat(inside, runs)
    return np.ascontiguousarray(filled.reshape(width, height).T)


def decode_counts(text: str | bytes, where: str) -> IntArray:
    """Decode the string form of the counts.

    Raises:
        InputError: If it holds characters that do not belong there, or is cut short.
    """
    raw = text.encode("utf-8", "replace") if isinstance(text, str) else text
    groups = np.frombuffer(raw, np.uint8).astype(np.int64) - 48
    if len(groups) == 0:
        return np.zeros(0, np.int64)
    if (groups < 0).any() or (groups > 63).any() or groups[-1] & 32:
        raise InputError(f"{where}: 'counts' is no compressed run-length string, or cut short")
    last = (groups & 32) == 0
    number = np.concatenate(([0], np.cumsum(last)[:-1]))
    start = np.concatenate(([0], np.flatnonzero(last)[:-1] + 1))
    position = np.arange(len(groups)) - start[number]
    if int(position.max()) >= _MAX_GROUPS:
        raise InputError(f"{where}: 'counts' holds a number that is too large")
    values = np.zeros(int(last.sum()), np.int64)
    np.add.at(values, number, (groups & 31) << (5 * position))
    negative = (groups[last] & 16) > 0
    values -= np.where(negative, np.int64(1) << (5 * (position[last] + 1)), 0)
    # Counts 1, 3, 5, ... and 2, 4, 6, ... are running sums; count 0 stands alone.
    values[1::2] = np.cumsum(values[1::2])
    values[2::2] = np.cumsum(values[2::2])
    return values
