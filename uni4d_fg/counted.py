"""Numbers of things in words."""

from __future__ import annotations


def counted(number: int, singular: str, plural: str | None = None) -> str:
    """Return ``1 track`` or ``2 tracks``; ``plural`` where it does not end in s."""
    return f"{number} {singular if number == 1 else plural or singular + 's'}"
