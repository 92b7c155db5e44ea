"""Files that are written on a thread of their own while a run goes on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType


class WrittenBeside:
    """Writes one file after the other, in the order in which they were handed over.

    Compression takes most of a write and does not hold up Python's other threads. Where a write fails, none of those
    after it is begun: a stage's record, which is handed over last, never vouches for files that are not there. The
    arrays that are written must not be changed any more.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1)
        self._last: Future[None] | None = None

    def __enter__(self) -> WrittenBeside:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for all writes. Raises as :meth:`wait`, unless something else went wrong before."""
        self._thread.shutdown()
        if kind is None:
            self.wait()

    def put(self, write: Callable[[], None]) -> None:
        """Hand over what writes a file.

        Raises:
            OutputError: If one before could not be written.
        """
        before = self._last
        if before is not None and before.done():
            before.result()
        self._last = self._thread.submit(_after, before, write)

    def wait(self) -> None:
        """Wait until all files are written.

        Raises:
            OutputError: If one could not be.
        """
        if self._last is not None:
            self._last.result()


def _after(before: Future[None] | None, write: Callable[[], None]) -> None:
    if before is not None:
        before.result()  # its error is that of all that follow
    write()
