"""What runs in a worker process: one task with its threads, and an end to it when its time is up.

The end is a watchdog of ``faulthandler``, a thread of C: it needs no interpreter lock, so that a loop in a library is
ended too. It writes where the task hung and ends the process; Dask's nanny then starts another.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from uni4d_fg.errors import ConfigError
from uni4d_fg.optim.threads import thread_limit

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")

_ALONE = threading.Lock()


def guarded(
    function: Callable[[ItemT], ResultT], item: ItemT, threads: int, time_limit: float | None, trace: Path
) -> ResultT:
    """Apply a function with a number of threads; end the process if that takes longer than ``time_limit`` seconds.

    Args:
        function: Of a module that the worker can import.
        item: Its argument.
        threads: Of the solvers and BLAS.
        time_limit: s; None: no limit.
        trace: Where is written what the process was doing when its time was up; it is there, empty, while the
            function runs, and stays if the process dies.

    Raises:
        ConfigError: If another task runs in this process: threads and the watchdog are the process's.
    """
    if not _ALONE.acquire(blocking=False):
        raise ConfigError("two tasks run in one worker process: start the workers with `--nthreads 1`")
    try:
        with thread_limit(threads), _watchdog(time_limit, trace):
            return function(item)
    finally:
        _ALONE.release()


@contextlib.contextmanager
def _watchdog(time_limit: float | None, trace: Path) -> Iterator[None]:
    trace.parent.mkdir(parents=True, exist_ok=True)
    with trace.open("w", encoding="utf-8") as file:
        if time_limit is not None:
            faulthandler.dump_traceback_later(time_limit, exit=True, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
    trace.unlink(missing_ok=True)


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C to the process that started the workers; Dask calls this when a local worker starts."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def dask_teardown(worker: Any) -> None:
    """Let the process end without a search for cycles in what goes back to the system anyway."""
    gc.freeze()
