"""What timings depend on: processor, cores, versions."""

from __future__ import annotations

import platform
from pathlib import Path

from uni4d_fg.errors import MissingDependencyError
from uni4d_fg.optim.threads import thread_count
from uni4d_fg.optional import import_torch
from uni4d_fg.pipeline.summary import versions


def machine() -> dict[str, str]:
    """Return the machine and the versions by name; torch's threads only where torch can be loaded."""
    return {
        "processor": _processor(),
        "system": f"{platform.system()} {platform.machine()}",
        "cores": str(thread_count()),
        **_torch_threads(),
        **versions(),
    }


def _torch_threads() -> dict[str, str]:
    try:
        return {"torch threads": str(import_torch().get_num_threads())}
    except MissingDependencyError:  # of an extra, which only Adam needs
        return {}


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"
