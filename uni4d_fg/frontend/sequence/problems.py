"""One wrong thing in a sequence, in three parts: where, what, and what to do."""

from __future__ import annotations

from collections.abc import Sequence as SequenceOf
from pathlib import Path

from uni4d_fg.errors import InputError

_GENERAL_REMEDY = "repair or replace it"


class SequenceProblem(InputError):
    """An :class:`InputError` whose parts can be listed one by one.

    Attributes:
        where: File, folder or item concerned.
        what: What was found.
        remedy: What to do about it.
    """

    def __init__(self, where: Path | str, what: str, remedy: str) -> None:
        super().__init__(f"{where}: {what}; {remedy}")
        self.where = str(where)
        self.what = what
        self.remedy = remedy


def parts_of(error: InputError) -> tuple[str, str]:
    """Return (message with its place, remedy) of any input error."""
    if isinstance(error, SequenceProblem):
        return f"{error.where}: {error.what}", error.remedy
    message, separator, remedy = str(error).rpartition("; ")
    return (message, remedy) if separator else (str(error), _GENERAL_REMEDY)


def some_of(values: SequenceOf[object], limit: int = 5) -> str:
    """Return the first few values as text, with how many more there are."""
    text = ", ".join(str(value) for value in values[:limit])
    return text if len(values) <= limit else f"{text} and {len(values) - limit} more"
