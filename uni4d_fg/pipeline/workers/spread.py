"""Giving tasks to workers one by one, and again where a worker died."""

from __future__ import annotations

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from uni4d_fg.counted import counted
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.optional import import_distributed
from uni4d_fg.pipeline.workers.guarded import guarded
from uni4d_fg.pipeline.workers.options import WorkerOptions

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")

_POLL_SECONDS = 0.5
_UNSTARTED = 20
"""How often a task may be given to a worker that dies before it begins."""


@dataclass(frozen=True)
class Lost:
    """A task without a result."""

    why: str


def spread(
    client: Any,
    function: Callable[[ItemT], ResultT],
    items: Sequence[ItemT],
    options: WorkerOptions,
    traces: Sequence[Path],
    should_stop: Callable[[], bool] | None = None,
) -> Iterator[tuple[int, ResultT | Lost]]:
    """Apply a function to independent items on the workers of a client.

    A worker works on one task at a time, and while there are many it has the next one already. One that dies takes no
    other task with it: that which it had not begun is given to another. What is tried again is counted here, whatever
    the scheduler is told.

    Args:
        client: Of :func:`~uni4d_fg.pipeline.workers.cluster.open_workers`.
        function: Of a module that the workers can import.
        items: Its arguments.
        options: Threads, time limit and retries.
        traces: Per item, the file that says where it hung.
        should_stop: Polled often.

    Yields:
        Index and result of each item, as they come.

    Raises:
        Cancelled: If ``should_stop`` turned true; what is not finished is abandoned.
        InputError: If no worker has been there for ``options.workerless_limit``, or the scheduler does not answer.
    """
    distributed = import_distributed()
    waiting = deque(range(len(items)))
    attempts, unstarted = [0] * len(items), [0] * len(items)
    flying: dict[Any, tuple[int, str]] = {}
    ready = _Ahead(items)
    last_seen = time.monotonic()
    ended: list[tuple[int, ResultT | Lost]] = []
    """Handed out once the workers have something else to do."""
    try:
        while waiting or flying:
            if should_stop is not None and should_stop():
                raise Cancelled("stopped; finished tasks are kept")
            present = _present(client)
            if present:
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > options.workerless_limit:
                raise InputError(
                    f"no worker has been there for {options.workerless_limit:g} s, while "
                    f"{counted(len(waiting) + len(flying), 'task')} must still be done: see why the workers ended "
                    "(memory?), start others, and run the same command again; finished tasks are kept"
                )
            for address in _next_workers(present, [address for _, address in flying.values()], len(waiting)):
                index = waiting.popleft()
                attempts[index] += 1
                traces[index].unlink(missing_ok=True)
                future = client.submit(
                    guarded, function, ready.take(index), options.threads, options.time_limit, traces[index],
                    workers=[address], pure=False,
                )  # fmt: skip
                flying[future] = index, address
            yield from ended
            ended = []
            if waiting:
                ready.make(waiting[0])
            done = _finished(flying, distributed)
            gone = [f for f, (_, address) in flying.items() if f not in done and address not in present]
            for future in [*done, *gone]:
                index, _ = flying.pop(future)
                if future.status == "finished":
                    # Fetched at once: the worker may die of what it gets next.
                    ended.append((index, future.result()))
                elif future.status == "error" and not isinstance(future.exception(), distributed.KilledWorker):
                    ended.append((index, Lost(_said(future))))
                else:
                    client.cancel([future], force=True)
                    if not traces[index].exists() and unstarted[index] < _UNSTARTED:
                        # It was given to a worker that was dying already.
                        unstarted[index] += 1
                        attempts[index] -= 1
                        waiting.append(index)
                    elif attempts[index] <= options.retries:
                        waiting.append(index)
                    else:
                        ended.append((index, Lost(_obituary(traces[index], attempts[index], options))))
        yield from ended
    finally:
        with contextlib.suppress(OSError, TimeoutError):  # the scheduler may be gone, and its tasks with it
            client.cancel(list(flying), force=True)


class _Ahead(Generic[ItemT]):
    """Items, of which the next is made while the workers are busy."""

    def __init__(self, items: Sequence[ItemT]) -> None:
        self._items, self._made = items, dict[int, ItemT]()

    def make(self, index: int) -> None:
        """Make an item that will be taken next."""
        if index not in self._made:
            self._made = {index: self._items[index]}

    def take(self, index: int) -> ItemT:
        """Return an item, which is forgotten."""
        return self._made.pop(index) if index in self._made else self._items[index]


def _next_workers(present: set[str], busy: list[str], waiting: int) -> list[str]:
    """Return the workers that get the next tasks, at most one each.

    Those that have none come first. The others get one ahead only while as many tasks as workers are left for later:
    the last ones go to whoever is done first.

    Args:
        present: All workers.
        busy: The worker of every task that is given out.
        waiting: Number of tasks that are not.
    """
    tasks = Counter(busy)
    idle = sorted(present - tasks.keys())[:waiting]
    ahead = sorted(worker for worker in present if tasks[worker] == 1)
    return idle + ahead[: max(waiting - len(idle) - len(present), 0)]


def _present(client: Any) -> set[str]:
    """Return the addresses of the workers that are there."""
    try:
        return set(client.nthreads())
    except (OSError, TimeoutError) as error:
        raise InputError(
            f"the Dask scheduler no longer answers ({' '.join(str(error).split())}); start it again, and run the same "
            "command again: finished tasks are kept"
        ) from error


def _finished(flying: dict[Any, tuple[int, str]], distributed: Any) -> list[Any]:
    """Wait a moment for one of the futures to end; return those that have."""
    if not flying:
        time.sleep(_POLL_SECONDS)  # until there is a worker
        return []
    try:
        return list(distributed.wait(list(flying), timeout=_POLL_SECONDS, return_when="FIRST_COMPLETED").done)
    except (TimeoutError, distributed.TimeoutError):
        return []


def _said(future: Any) -> str:
    error = future.exception()
    return f"{type(error).__name__}: {error}"


def _obituary(trace: Path, attempts: int, options: WorkerOptions) -> str:
    times = f" {attempts} times" if attempts > 1 else ""
    try:
        hung = trace.stat().st_size > 0
    except OSError:
        hung = False
    if hung:
        return f"ended{times} after {options.time_limit:g} s, the time limit; {trace} says where it was"
    trace.unlink(missing_ok=True)
    return f"its process died{times} (killed, out of memory, or a crash in a library)"
