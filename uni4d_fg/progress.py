"""How long work tells its caller where it is, without printing."""

from __future__ import annotations

from typing import Protocol


class Reporter(Protocol):
    """Receives progress; the command line draws it, a library user may ignore it."""

    def begin(self, task: str, total: int | None) -> None:
        """A task starts; ``total`` units of work, or None when unknown."""
        ...

    def advance(self, done: int, text: str = "") -> None:
        """``done`` units of the current task are finished; ``text`` is one short line."""
        ...

    def end(self, text: str = "") -> None:
        """The current task is finished."""
        ...


class SilentReporter:
    """A reporter that drops everything."""

    def begin(self, task: str, total: int | None) -> None:
        """Do nothing."""

    def advance(self, done: int, text: str = "") -> None:
        """Do nothing."""

    def end(self, text: str = "") -> None:
        """Do nothing."""
