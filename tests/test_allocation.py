"""Memory of large arrays that were freed is used again; the user's own settings of the allocator stay."""

from __future__ import annotations

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
