"""Hashes of arrays, and of all frames of one kind."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np

from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.model import FrameSource


def frames_digest(
    frames: FrameSource[Any],
    should_stop: Callable[[], bool] | None = None,
    check: Callable[[Any, int], object] | None = None,
) -> bytes:
    """Return a hash that changes with every pixel of every frame; frames are read once, in their order.

    Args:
        frames: Images, depth maps or masks.
        should_stop: Asked before every frame.
        check: Told every frame with its number; raises what is to be said of it.

    Raises:
        Cancelled: If ``should_stop`` said so.
        InputError: If a frame cannot be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    for number in range(len(frames)):
        if should_stop is not None and should_stop():
            raise Cancelled("stopped while reading the frames")
        frame = frames[number]
        if check is not None:
            check(frame, number)
        add_array(digest, frame)
    return digest.digest()


def add_array(digest: hashlib.blake2b, array: np.ndarray) -> None:
    """Add an array, with its shape and type, to a hash."""
    digest.update(f"{array.shape} {array.dtype}".encode())
    digest.update(np.ascontiguousarray(array).data)
