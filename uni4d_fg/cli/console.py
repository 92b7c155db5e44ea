"""What is printed: results on standard output, everything else on standard error."""

from __future__ import annotations

import contextlib
import logging
from typing import Any

import typer
from rich.console import Console
from rich.logging import RichHandler

from uni4d_fg.counted import counted
from uni4d_fg.files import json_text
from uni4d_fg.frontend.sequence.report import ItemSummary, ValidationReport

STDERR = Console(stderr=True)


def log_to_stderr(verbose: bool) -> None:
    """Show the library's log messages: warnings, or with ``verbose`` everything."""
    logger = logging.getLogger("uni4d_fg")
    if not logger.handlers:
        logger.addHandler(RichHandler(console=STDERR, show_time=False, show_path=False))
    logger.setLevel(logging.DEBUG if verbose else logging.WARNING)


def one_line(error: BaseException) -> str:
    """Return the message of an error without line breaks."""
    return " ".join(str(error).split()) or type(error).__name__


def print_error(message: str, kind: str = "error") -> None:
    """Print one line on standard error, if there is one; what cannot be encoded is written as escapes."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        text = f"{kind}: {message}"
        typer.echo(text.encode("utf-8", "backslashreplace").decode("utf-8"), err=True)


def duration(seconds: float) -> str:
    """Return a time as a person says it: ``42.1 s``, ``3 min 7 s``, ``1 h 12 min``."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output."""
    typer.echo(json_text(value))


def validation_text(report: ValidationReport) -> str:
    """Return a validation report as a table of what is there and a list of findings."""
    lines = [f"{report.root}: {report.layout or 'unknown'} layout", ""]
    lines += table_lines(("item", "count", "shape", "type", "range"), [_item_row(item) for item in report.items])
    for severity in ("error", "warning", "info"):
        for finding in report.of(severity):
            lines += ["", f"{severity}: {finding.item}: {finding.message}", f"    to do: {finding.remedy}"]
    counts = ", ".join(counted(len(report.of(s)), s) for s in ("error", "warning"))
    verdict = "can be reconstructed" if report.ok else "cannot be reconstructed as it is"
    return "\n".join([*lines, "", f"{verdict}: {counts}"])


def _item_row(item: ItemSummary) -> tuple[str, ...]:
    limits = "-" if item.range is None else f"{item.range[0]:.4g} to {item.range[1]:.4g}"
    return item.name, str(item.count), " x ".join(map(str, item.shape)) or "-", item.dtype or "-", limits


def table_lines(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """Return a table as aligned lines; none without rows."""
    if not rows:
        return []
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in (head, *rows)
    ]
