"""How many processes a machine can hold at once."""

from __future__ import annotations

import os
from pathlib import Path

_CGROUP_LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
_BASE_BYTES = 700 * 2**20
"""Of a process with all libraries loaded, and the graph of a minute of video."""
_BYTES_PER_PIXEL = 50
"""Per pixel and frame: image, depth, mask, fused depth, and what they are made from."""


def reconstruction_bytes(num_frames: int, image_size: tuple[int, int]) -> int:
    """Return roughly what the reconstruction of a video of (height, width) needs, bytes; on the safe side."""
    height, width = image_size
    return _BASE_BYTES + _BYTES_PER_PIXEL * num_frames * height * width


def free_bytes() -> int | None:
    """Return the memory that can be had without swapping, bytes; None where the system does not tell."""
    found = []
    try:
        for line in Path("/proc/meminfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("MemAvailable:"):
                found.append(1024 * int(line.split()[1]))
    except OSError:
        pass
    for limit, used in _CGROUP_LIMITS:  # a container may have less than its machine
        try:
            found.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
        except (OSError, ValueError):  # no such group, or "max"
            continue
    if not found:
        try:
            found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES"))
        except (AttributeError, OSError, ValueError):
            return None
    return max(min(found), 0)


def worker_count(tasks: int, need_bytes: int, cores: int, free: int | None) -> int:
    """Return how many tasks may run at once.

    Args:
        tasks: How many there are.
        need_bytes: Of the largest.
        cores: How many may be used, at the threads of a task.
        free: Free memory, bytes; None if it is not known.
    """
    fit = cores if free is None else free // max(need_bytes, 1)
    return int(max(1, min(tasks, cores, fit)))
