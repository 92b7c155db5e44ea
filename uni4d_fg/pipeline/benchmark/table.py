"""A table of methods or videos by scores, and its four forms: Markdown, LaTeX, CSV, plain data for JSON."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

Kind: TypeAlias = Literal["run", "read", "published"]
"""Of a row: run here, read from another program's files, or printed in a paper."""

_MARKS: dict[Kind, str] = {"run": "", "read": " (read)", "published": " (published)"}
_LATEX = {"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}"}
_LATEX |= {"^": r"\textasciicircum{}", "\\": r"\textbackslash{}", "<": "$<$", ">": "$>$"}


@dataclass(frozen=True)
class Column:
    """One score."""

    name: str
    digits: int = 3
    better: Literal["low", "high", ""] = "low"


@dataclass(frozen=True)
class Row:
    """One method or video."""

    name: str
    values: dict[str, float | int | None]
    """By name of column; one that is absent or None is shown as a dash."""
    kind: Kind = "run"
    source: str = ""
    """Of what is published or read."""


@dataclass(frozen=True)
class Table:
    """Rows by columns."""

    name: str
    """Of its files."""
    title: str
    head: str
    """What rows are."""
    columns: list[Column]
    rows: list[Row]
    notes: list[str] = field(default_factory=list)

    def cells(self) -> list[list[str]]:
        """Return the text of every row."""
        return [
            [f"{row.name}{_MARKS[row.kind]}", *(_text(row.values.get(c.name), c.digits) for c in self.columns)]
            for row in self.rows
        ]

    def names(self) -> list[str]:
        """Return the text of the head."""
        arrows = {"low": " ↓", "high": " ↑", "": ""}
        return [self.head, *(f"{column.name}{arrows[column.better]}" for column in self.columns)]

    def markdown(self) -> str:
        """Return a section with the table, its notes and sources."""
        lines = [f"### {self.title}", ""]
        lines += [f"| {' | '.join(cells)} |" for cells in (self.names(), self._rule(), *self.cells())]
        notes = self.notes + self.sources()
        return "\n".join([*lines, "", *(f"- {note}" for note in notes), ""]) + "\n"

    def latex(self) -> str:
        """Return a ``tabular`` in booktabs' style; the best of a column, published rows left out, is bold."""
        arrows = {"low": r"$\downarrow$", "high": r"$\uparrow$", "": ""}
        head = [latex_text(self.head), *(f"{latex_text(c.name)} {arrows[c.better]}".strip() for c in self.columns)]
        best = [self._best(column) for column in self.columns]
        lines = [rf"% {self.title}", *(f"% {note}" for note in self.notes + self.sources())]
        lines += [rf"\begin{{tabular}}{{l{'c' * len(self.columns)}}}", r"\toprule", f"{' & '.join(head)} \\\\"]
        lines.append(r"\midrule")
        for row, cells in zip(self.rows, self.cells(), strict=True):
            shown = [
                rf"\textbf{{{latex_text(cell)}}}" if row.kind != "published" and cell == bold else latex_text(cell)
                for cell, bold in zip(cells[1:], best, strict=True)
            ]
            lines.append(f"{' & '.join([latex_text(cells[0]), *shown])} \\\\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])

    def comma_separated(self) -> str:
        """Return the rows with all digits."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([self.head, "kind", "source", *(column.name for column in self.columns)])
        for row in self.rows:
            values = [row.values.get(column.name) for column in self.columns]
            writer.writerow([row.name, row.kind, row.source, *("" if v is None else repr(v) for v in values)])
        return stream.getvalue()

    def data(self) -> dict[str, Any]:
        """Return plain values."""
        rows = [{"name": r.name, "kind": r.kind, "source": r.source, "values": r.values} for r in self.rows]
        return {
            "name": self.name, "title": self.title, "columns": [c.name for c in self.columns], "rows": rows,
            "notes": self.notes,
        }  # fmt: skip

    def sources(self) -> list[str]:
        """Return where rows that were not run come from, rows of one source together."""
        names: dict[str, list[str]] = {}
        for row in self.rows:
            if row.source:
                names.setdefault(row.source, []).append(row.name)
        return [f"{', '.join(dict.fromkeys(rows))}: {source}" for source, rows in names.items()]

    def _rule(self) -> list[str]:
        return ["---", *("---:" for _ in self.columns)]

    def _best(self, column: Column) -> str | None:
        values = [row.values.get(column.name) for row in self.rows if row.kind != "published"]
        known = [value for value in values if value is not None]
        if not known or not column.better:
            return None
        return _text(min(known) if column.better == "low" else max(known), column.digits)


def latex_text(text: str) -> str:
    """Return text with what LaTeX takes for commands escaped."""
    return "".join(_LATEX.get(letter, letter) for letter in text)


def _text(value: float | int | None, digits: int) -> str:
    if value is None:
        return "–"
    if isinstance(value, int):
        return str(value)
    # Of a number that begins in the last digits two are shown: millimeters in a column of meters.
    small = digits > 0 and 10.0 ** (-2 - digits) < abs(value) < 10.0 ** (1 - digits)
    return np.format_float_positional(float(f"{value:.1e}"), trim="k") if small else f"{value:.{digits}f}"
