"""Finished parts of a comparison on disk: one JSON file each, trusted only if its key fits."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter

from uni4d_fg.errors import InputError
from uni4d_fg.files import atomic_write_text
from uni4d_fg.reading import read_json

ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class ResultStore:
    """A folder of parts."""

    folder: Path
    resume: bool
    """Whether stored parts are taken over."""

    def get(self, name: str, key: str, kind: type[ResultT], compute: Callable[[], ResultT]) -> ResultT:
        """Return the stored part of this key, or compute and store it.

        Args:
            name: File name without its ending.
            key: What the part depends on.
            kind: Dataclass of the part.
            compute: Makes it.

        Raises:
            OutputError: If it cannot be written.
        """
        path, adapter = self.folder / f"{name}.json", TypeAdapter(kind)
        if self.resume and path.is_file():
            try:
                stored = read_json(path)
                if stored.get("key") == key:
                    return adapter.validate_python(stored["part"])
            except (InputError, ValueError, KeyError, AttributeError, RecursionError):
                pass  # made again
        part = compute()
        text = json.dumps({"key": key, "part": adapter.dump_python(part, mode="json")})
        atomic_write_text(path, text)
        return part
