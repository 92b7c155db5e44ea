"""Ctrl-C: the first press asks the work to end cleanly, the second ends it at once."""

from __future__ import annotations

import os
import shlex
import signal
import sys
from types import FrameType, TracebackType

from uni4d_fg.errors import Cancelled


class Interruption:
    """A context in which Ctrl-C sets a flag; the object itself is the ``should_stop`` of library calls."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self) -> bool:
        """Tell whether the work should stop."""
        return self.requested

    def __enter__(self) -> Interruption:
        self._previous = signal.signal(signal.SIGINT, self._on_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGINT, self._previous)
        if kind is KeyboardInterrupt:
            raise Cancelled("aborted; what was finished before is on disk") from None

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        # A signal may come in the middle of a print: the stream's own buffer must not be touched.
        os.write(2, b"\nstopping as soon as the current step allows; press Ctrl-C again to abort\n")


def resume_command() -> str:
    """Return this process's command line with ``--resume``."""
    words = [word for word in sys.argv[1:] if word not in ("--resume", "--overwrite")]
    return shlex.join(["uni4d-fg", *words, "--resume"])
