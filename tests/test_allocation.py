"""Memory of large arrays that were freed is used again; the user's own settings of the allocator stay."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys

import pytest

from uni4d_fg.allocation import SETTINGS

pytestmark = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are glibc's")

PAGES = 40 << 8
"""Of 4 KiB in an array of 40 MiB, which glibc maps anew each time on its own."""

COUNT_FAULTS = """
import resource
import numpy as np
from uni4d_fg.allocation import keep_freed_memory

keep_freed_memory()
np.ones(5 << 20)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    np.ones(5 << 20)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(**variables: str) -> int:
    """Page faults of ten arrays of 40 MiB, one after the other, in a fresh process."""
    own = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    # Without huge pages, which would hide most of the faults.
    environment = {**own, "NUMPY_MADVISE_HUGEPAGE": "0", **variables}
    done = subprocess.run(
        [sys.executable, "-c", COUNT_FAULTS], env=environment, check=True, capture_output=True, text=True
    )
    return int(done.stdout)


def test_freed_arrays_are_not_mapped_again() -> None:
    assert faults() < 0.1 * PAGES


def test_what_the_environment_sets_stays() -> None:
    assert faults(MALLOC_MMAP_THRESHOLD_="131072") > 9 * PAGES


RETURN = """
import sys
import numpy as np
from uni4d_fg.allocation import return_free_memory

def pages():
    with open("/proc/self/statm") as counts:
        return int(counts.read().split()[1])

arrays = [np.ones(8 << 10) for _ in range(1600)]
kept = arrays[::64]
full = pages()
del arrays
return_free_memory(int(sys.argv[1]))
print(full - pages())
"""
"""100 MiB in arrays too small to be mapped, of which those that stay hold up the top of the heap."""


def returned(at_least: int) -> int:
    """Pages that the process has fewer once nearly all arrays are freed."""
    own = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    environment = {**own, "MALLOC_TRIM_THRESHOLD_": str(1 << 30)}  # nothing is returned unasked
    done = subprocess.run(
        [sys.executable, "-c", RETURN, str(at_least)], env=environment, check=True, capture_output=True, text=True
    )
    return int(done.stdout)


def test_much_free_memory_is_returned() -> None:
    assert returned(0) > 80 << 8
    assert returned(50 << 20) > 80 << 8


def test_little_free_memory_is_kept() -> None:
    if not hasattr(ctypes.CDLL(None), "mallinfo2"):
        pytest.skip("before glibc 2.33 it does not say how much is free")
    assert returned(200 << 20) < 10 << 8
