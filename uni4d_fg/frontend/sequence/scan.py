"""Reading every frame of a source once, keeping only statistics and what went wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import IntArray
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.frames import LazyFrames
from uni4d_fg.frontend.sequence.problems import parts_of
from uni4d_fg.frontend.sequence.report import Finding, ItemSummary, Severity

MAX_LISTED_FRAMES = 20
"""Unreadable frames of one item that are listed one by one."""

R = TypeVar("R")


@dataclass
class Findings:
    """What is being collected; nothing raised by bad content passes :meth:`attempt`."""

    findings: list[Finding] = field(default_factory=list)
    items: list[ItemSummary] = field(default_factory=list)

    def add(self, severity: Severity, item: str, message: str, remedy: str) -> None:
        """Add one finding."""
        self.findings.append(Finding(severity, item, message, remedy))

    def add_error(self, item: str, error: InputError, severity: Severity = "error") -> None:
        """Add an input error as a finding."""
        self.add(severity, item, *parts_of(error))

    def attempt(self, item: str, action: Callable[[], R], severity: Severity = "error") -> R | None:
        """Return what ``action`` returns; when it fails on its input, add a finding and return None."""
        try:
            return action()
        except InputError as error:
            self.add_error(item, error, severity)
        except OSError as error:
            self.add(severity, item, f"cannot be read ({error})", "check that the files exist and are readable")
        except MemoryError:
            self.add(severity, item, "does not fit into memory", "use smaller images or fewer tracks")
        return None

    def add_array(self, name: str, array: npt.NDArray[Any], count: int | None = None) -> None:
        """Add a row of the table for a whole array."""
        limits = value_range(array)
        rows = len(array) if count is None else count
        self.items.append(ItemSummary(name, rows, array.shape, str(array.dtype), limits))


def value_range(array: npt.NDArray[Any]) -> tuple[float, float] | None:
    """Return the smallest and largest finite value of an array, or None."""
    values = array[np.isfinite(array)] if array.dtype.kind == "f" else array
    return (float(values.min()), float(values.max())) if values.size else None


def scan_frames(
    item: str,
    frames: LazyFrames[Any],
    findings: Findings,
    visit: Callable[[int, npt.NDArray[Any]], None] = lambda frame, array: None,
    chosen: IntArray | None = None,
) -> None:
    """Read frames, list those that cannot be read, and add a row to the table.

    Args:
        item: Name of the source.
        frames: The source.
        findings: Where findings and the row go.
        visit: Called with the frame number and array of each readable frame.
        chosen: (N,) frames that are looked at, increasing; all when None. Whoever opens the source reads the first as
            well.
    """
    chosen = np.arange(len(frames)) if chosen is None else chosen
    if len(frames) and len(chosen) and chosen[0] > 0:
        findings.attempt(item, lambda: frames[0])
    low, high = np.inf, -np.inf
    shape: tuple[int, ...] = ()
    dtype = ""
    unlisted = 0
    listed = 0
    for frame in chosen.tolist():
        try:
            array = frames[frame]
        except InputError as error:
            if listed < MAX_LISTED_FRAMES:
                findings.add_error(item, error)
                listed += 1
            else:
                unlisted += 1
            continue
        shape, dtype = array.shape, str(array.dtype)
        limits = value_range(array)
        if limits is not None:
            low, high = min(low, limits[0]), max(high, limits[1])
        visit(frame, array)
    if unlisted:
        findings.add("error", item, f"{unlisted} more frames cannot be used either", "repair or remove them all")
    limits = (low, high) if low <= high else None
    findings.items.append(ItemSummary(item, len(chosen), shape, dtype, limits))
