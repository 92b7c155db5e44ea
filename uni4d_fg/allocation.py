"""How glibc's allocator deals with large arrays.

By default it maps every array above some size from the system and hands it back when it is freed; the next one is
mapped anew, and the system clears each of its pages at first touch. It also gives every thread a heap of its own, which
keeps what was freed there from the others. A run on kitchen_dog took 214,000 page faults and 790 MB so; with the
settings below it takes 130,000 and 660 MB, and 4 % less time.
"""

from __future__ import annotations

import ctypes
import os
import sys

SETTINGS = {"MALLOC_ARENA_MAX": 1, "MALLOC_MMAP_THRESHOLD_": 128 << 20, "MALLOC_TRIM_THRESHOLD_": 128 << 20}
"""glibc's environment variables: number of heaps; bytes from which an array is mapped; free bytes that are kept."""

_PARAMETERS = {"MALLOC_TRIM_THRESHOLD_": -1, "MALLOC_MMAP_THRESHOLD_": -3, "MALLOC_ARENA_MAX": -8}
"""Their numbers in glibc's ``malloc.h`` (M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX)."""


def keep_freed_memory() -> None:
    """Apply :data:`SETTINGS` to this process, as early as possible; not those that its environment sets itself.

    Nothing happens with another C library, whose allocator has other rules.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    except OSError:
        return
    if mallopt is None:
        return
    for variable, value in SETTINGS.items():
        if variable not in os.environ:
            mallopt(_PARAMETERS[variable], value)
