"""Where the process starts: before the second that loading the program takes, Ctrl-C is made to end it quietly."""

from __future__ import annotations

import gc
import os
import signal
import sys
from types import FrameType

from uni4d_fg.allocation import keep_freed_memory

_IDLE_THREADS = {"OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN": "0", "OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER": "0"}
"""OpenCV's threads wait for each other in loops, which took a twentieth of all processor time from those that work."""


def _end(number: int, frame: FrameType | None) -> None:
    """End the process at once: an exception would get lost in the libraries that are being loaded."""
    os.write(2, b"\nstopped: aborted\n")
    os._exit(130)


def main() -> None:
    """Load the command line and run it; verbs that do more than a moment's work take Ctrl-C over."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started this process
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - open until the end
        with_escapes = getattr(getattr(sys, name), "reconfigure", None)
        if with_escapes is not None:
            with_escapes(errors="backslashreplace")
    keep_freed_memory()
    for variable, value in _IDLE_THREADS.items():
        os.environ.setdefault(variable, value)
    from uni4d_fg.cli.main import main as run

    try:
        run()
    finally:
        # The memory goes back with the process: to search it for cycles twice more takes half a second.
        gc.freeze()


if __name__ == "__main__":
    main()
