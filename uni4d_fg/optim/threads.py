"""How many threads the array code may use, and keeping BLAS out of their way."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager
from functools import cache, wraps
from typing import Any, ParamSpec, Protocol, TypeVar, cast

from threadpoolctl import ThreadpoolController

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")
P = ParamSpec("P")


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[Any]:
    """Limit BLAS to one thread per caller while our own threads divide the work."""
    limited: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limited


def on_one_blas_thread(function: Callable[P, ResultT]) -> Callable[P, ResultT]:
    """Let a function run with BLAS limited as by :func:`one_blas_thread`."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> ResultT:
        with one_blas_thread():
            return function(*args, **kwargs)

    return limited


_limits: list[int] = []
"""Of the contexts of :func:`thread_limit` that are open; the last one counts."""


@contextmanager
def thread_limit(count: int) -> Iterator[None]:
    """Give all array code of this process a number of threads: the solvers, BLAS, OpenMP and OpenCV.

    Solvers give the same on any number of threads. Libraries may not: results of equal numbers are equal to the last
    bit, on as many cores as there may be.
    """
    import cv2

    before = cv2.getNumThreads()
    _limits.append(count)
    cv2.setNumThreads(count)
    try:
        with ThreadpoolController().limit(limits=count):
            yield
    finally:
        _limits.pop()
        cv2.setNumThreads(before)


def current_limit() -> int | None:
    """Return the number of threads of the innermost :func:`thread_limit`; None outside of any."""
    return _limits[-1] if _limits else None


def thread_count(requested: int | None = None) -> int:
    """Return the number of worker threads: as requested, else as limited, else the cores this process may use."""
    if requested is not None:
        return max(1, requested)
    if _limits:
        return _limits[-1]
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


def map_in_order(function: Callable[[ItemT], ResultT], items: list[ItemT], threads: int) -> list[ResultT]:
    """Apply a function to every item on worker threads; results in the order of the items.

    BLAS is limited to one thread even when ``threads`` is 1, so that its sums do not depend on that number.
    """
    with workers_in_order(threads if len(items) > 1 else 1) as mapped:
        return list(mapped(function, items))


class OrderedMap(Protocol):
    """Applies a function to items on worker threads, all of which start at once; results come in order."""

    def __call__(self, function: Callable[[ItemT], ResultT], items: list[ItemT], /) -> Iterator[ResultT]:
        """Return the results one by one, in the order of the items."""


@contextmanager
def workers_in_order(threads: int) -> Iterator[OrderedMap]:
    """Keep worker threads for many calls of what :func:`map_in_order` does; with one thread, the caller's own."""
    with one_blas_thread():
        if threads == 1:
            yield map
            return
        with ThreadPoolExecutor(threads) as pool:
            yield pool.map


def made_ahead(items: Generator[ItemT, None, None], threads: int, ahead: int = 2) -> Iterator[ItemT]:
    """Pass on what a generator yields, made on a thread of its own up to ``ahead`` items before it is asked for.

    With one thread each is made when it is asked for. The generator is closed when the caller is done with it.
    """
    if threads == 1:
        yield from items
        return
    end = object()
    with closing(items), ThreadPoolExecutor(1) as maker:
        coming = deque(maker.submit(next, items, end) for _ in range(ahead))
        while (item := coming.popleft().result()) is not end:
            coming.append(maker.submit(next, items, end))
            yield cast(ItemT, item)
