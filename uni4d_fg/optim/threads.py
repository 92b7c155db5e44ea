"""How many threads the array code may use, and keeping BLAS out of their way."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cache
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def limit_blas_threads(limit: int) -> AbstractContextManager[Any]:
    """Limit BLAS to a number of threads per caller."""
    limited: AbstractContextManager[Any] = _controller().limit(limits=limit, user_api="blas")
    return limited


def one_blas_thread() -> AbstractContextManager[Any]:
    """Limit BLAS to one thread per caller while our own threads divide the work."""
    return limit_blas_threads(1)


def thread_count(requested: int | None = None) -> int:
    """Return the number of worker threads: as requested, or the cores this process may use."""
    if requested is not None:
        return max(1, requested)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


def map_in_order(function: Callable[[ItemT], ResultT], items: list[ItemT], threads: int) -> list[ResultT]:
    """Apply a function to every item on worker threads; results in the order of the items.

    BLAS is limited to one thread even when ``threads`` is 1, so that its sums do not depend on that number.
    """
    with one_blas_thread():
        if threads == 1 or len(items) < 2:
            return [function(item) for item in items]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(function, items))
