"""Giving freed memory back to the system.

Every frame allocates and frees arrays of many sizes. glibc keeps what was freed in its heap, whose top a few small
arrays that live on hold up: the process grows over the first few hundred frames to a size that depends on the order of
things, not on what it holds. Trimming after every frame keeps the size at what is held.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache


@cache
def _trim() -> Callable[[int], int] | None:
    """Return glibc's ``malloc_trim``; None with another C library."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        trim: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    except OSError:
        return None
    return trim


def return_free_memory() -> None:
    """Hand freed heap pages back to the system where the C library can."""
    trim = _trim()
    if trim is not None:
        trim(0)
