"""Functions that worker processes import: what can go wrong with a task."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from uni4d_fg.optim.threads import thread_count


def square_or_die(item: tuple[int, str, Path]) -> tuple[int, int, int]:
    """Return (number squared, process, threads); a 'killed' or 'hung' one does so at its first attempt only."""
    number, fate, folder = item
    mark = folder / f"{number}.tried"
    first = not mark.exists()
    with mark.open("a") as file:
        file.write("x")
    if first or fate.startswith("always"):
        if fate.endswith("killed"):
            os.kill(os.getpid(), signal.SIGKILL)
        if fate.endswith("hung"):
            while True:
                time.sleep(3600)
        if fate.endswith("raised"):
            raise RuntimeError(f"number {number} is broken")
    return number * number, os.getpid(), thread_count()
