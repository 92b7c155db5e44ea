"""What timings depend on: processor, cores, versions."""

from __future__ import annotations

import platform
from pathlib import Path

from uni4d_fg.optim.threads import thread_count
from uni4d_fg.optional import import_torch
from uni4d_fg.pipeline.summary import versions


def machine() -> dict[str, str]:
    """Return the machine and the versions by name."""
    torch = import_torch()
    return {
        "processor": _processor(),
        "system": f"{platform.system()} {platform.machine()}",
        "cores": str(thread_count()),
        "torch threads": str(torch.get_num_threads()),
        **versions(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"
