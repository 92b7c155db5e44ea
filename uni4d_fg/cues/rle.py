"""Masks as runs of pixels, the way COCO's tools write them: plain lists of counts, and their compressed strings.

The runs go down the columns, from left to right, and alternate between outside and inside, beginning outside. The
string holds each count, from the third on as the difference to the one two before it, in groups of five bits with
the lowest first: ``48 + bits``, with 32 added where more follow; bit 16 of the last group is the sign.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uni4d_fg.arrays import BoolArray, IntArray
from uni4d_fg.errors import InputError

_MAX_GROUPS = 7
_MAX_PIXELS = 2**27
_MAX_CHARACTERS = 2**26
"""Running sums of so many numbers of seven groups stay within 64 bits."""


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
    height, width = rle_size(segmentation, where)
    counts = segmentation.get("counts")
    pixels = height * width
    if isinstance(counts, (str, bytes)):
        runs = decode_counts(counts, where)
    elif isinstance(counts, list | tuple) and all(type(n) is int for n in counts):
        # Python's numbers do not overflow; what is out of range is cut to what is refused below.
        runs = np.array([n if 0 <= n <= pixels else -1 for n in counts], np.int64)
    else:
        raise InputError(f"{where}: 'counts' must be a list of whole numbers or a string; write the file again")
    # A damaged file must not ask for memory before the sum is known to be right, nor the sum overflow.
    if len(runs) > 2 * pixels + 2 or (runs < 0).any() or (runs > pixels).any() or int(runs.sum()) != pixels:
        raise InputError(f"{where}: the runs do not fill {height} x {width} pixels; write the file again")
    inside = np.arange(len(runs)) % 2 == 1
    filled: BoolArray = np.repeat(inside, runs)
    return np.ascontiguousarray(filled.reshape(width, height).T)


def rle_size(segmentation: Any, where: str) -> tuple[int, int]:
    """Return the (height, width) that a mask gives itself.

    Raises:
        InputError: If it is no run-length mask, or larger than any image.
    """
    if isinstance(segmentation, list):
        raise InputError(f"{where}: is a polygon; write the mask as run lengths (RLE)")
    size = segmentation.get("size") if isinstance(segmentation, dict) else None
    if not (isinstance(size, list | tuple) and len(size) == 2 and all(type(n) is int and n > 0 for n in size)):
        raise InputError(f"{where}: is no run-length mask: it needs 'size' [height, width] and 'counts'")
    height, width = size
    if height * width > _MAX_PIXELS:
        raise InputError(f"{where}: is {height} x {width} px, more than {_MAX_PIXELS} in all; write the file again")
    return height, width


def decode_counts(text: str | bytes, where: str) -> IntArray:
    """Decode the string form of the counts.

    Raises:
        InputError: If it holds characters that do not belong there, or is cut short.
    """
    raw = text.encode("utf-8", "replace") if isinstance(text, str) else text
    if len(raw) > _MAX_CHARACTERS:
        raise InputError(f"{where}: 'counts' has {len(raw)} characters, more than any mask takes; write the file again")
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
