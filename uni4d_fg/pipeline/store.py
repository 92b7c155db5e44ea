"""Stage results on disk: one file per stage, written when the stage ends, trusted only if its key fits."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz, remove_file, save_npz


@dataclass(frozen=True)
class StageRecord:
    """What a stage leaves behind."""

    arrays: Mapping[str, npt.NDArray[Any]]
    summary: dict[str, Any]
    """Plain data for ``summary.json``."""


@dataclass(frozen=True)
class StageStore:
    """The folder ``RUN/stages``."""

    folder: Path

    def path(self, name: str) -> Path:
        """Return the file of a stage."""
        return self.folder / f"{name}.npz"

    def load(self, name: str, key: str | None = None, arrays: Iterable[str] | None = None) -> StageRecord | None:
        """Return a stage's record if it is there, readable and of this key (any key when None).

        Args:
            name: Of the stage.
            key: Its key.
            arrays: Those that are read; None for all of them.
        """
        path = self.path(name)
        if not path.exists():
            return None
        try:
            wanted = dict.fromkeys(["key", "summary", *(arrays or ())])
            found = load_npz(path, wanted, None if arrays is None else {})
            stored = str(found.pop("key"))
            if key is not None and stored != key:
                return None
            return StageRecord(found, json.loads(str(found.pop("summary"))))
        except (InputError, ValueError, KeyError):
            return None

    def discard(self, name: str) -> None:
        """Forget a stage's record.

        Raises:
            OutputError: If it cannot be removed.
        """
        remove_file(self.path(name))

    def save(self, name: str, key: str, record: StageRecord) -> None:
        """Write a stage's record, whole or not at all.

        Raises:
            OutputError: If it cannot be written.
        """
        text = json.dumps(record.summary)
        save_npz(self.path(name), key=np.array(key), summary=np.array(text), **record.arrays)
