"""What validation says: findings, each with a remedy, and a table of what is there."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True)
class Finding:
    """One thing to know about a sequence."""

    severity: Severity
    """"error": it cannot be used as it is; "warning": results may suffer; "info": good to know."""
    item: str
    """What it is about: "images", "depth", "masks", "tracks", ..."""
    message: str
    """What was found, and where."""
    remedy: str
    """What to do."""


@dataclass(frozen=True)
class ItemSummary:
    """One row of the table of what was found."""

    name: str
    count: int
    """Number of frames, tracks or matrices."""
    shape: tuple[int, ...]
    """Shape of one frame, or of the array."""
    dtype: str
    range: tuple[float, float] | None
    """Smallest and largest finite value; None when there is none."""


@dataclass(frozen=True)
class ValidationReport:
    """Everything found about one sequence folder."""

    root: Path
    layout: str | None
    """"native" or "uni4d"; None when that could not be told."""
    findings: tuple[Finding, ...]
    items: tuple[ItemSummary, ...]

    @property
    def ok(self) -> bool:
        """True if there is no error (warnings may remain)."""
        return not any(finding.severity == "error" for finding in self.findings)

    def of(self, severity: Severity) -> tuple[Finding, ...]:
        """Return the findings of one severity."""
        return tuple(finding for finding in self.findings if finding.severity == severity)

    def to_dict(self) -> dict[str, Any]:
        """Return the report in JSON's types."""
        return {
            "root": str(self.root),
            "layout": self.layout,
            "ok": self.ok,
            "findings": [asdict(finding) for finding in self.findings],
            "items": [
                {**asdict(item), "shape": list(item.shape), "range": item.range and list(item.range)}
                for item in self.items
            ],
        }
