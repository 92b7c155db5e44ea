"""Peak memory of a piece of work within a process."""

from __future__ import annotations

import gc
from pathlib import Path
from types import TracebackType

from uni4d_fg.allocation import return_free_memory

_STATUS = Path("/proc/self/status")
_RESET = Path("/proc/self/clear_refs")


class PeakMemory:
    """A context that measures the peak resident memory above that at its start.

    Linux only: elsewhere, or where the kernel does not let the peak be reset, ``extra_mb`` is None.
    """

    extra_mb: float | None = None

    def __enter__(self) -> PeakMemory:
        gc.collect()
        # Memory that the allocator keeps and uses again would else not be seen.
        return_free_memory()
        try:
            _RESET.write_text("5")
            self._before = _resident_mb("VmRSS")
        except OSError:
            self._before = None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        peak = _resident_mb("VmHWM") if self._before is not None else None
        if peak is not None and self._before is not None:
            self.extra_mb = max(peak - self._before, 0.0)


def _resident_mb(field: str) -> float | None:
    for line in _STATUS.read_text(encoding="ascii").splitlines():
        if line.startswith(f"{field}:"):
            return float(line.split()[1]) / 1024.0
    return None
