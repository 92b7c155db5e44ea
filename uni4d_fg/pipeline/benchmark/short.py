"""The table that a page begins with: one line per method, one column per kind of score."""

from __future__ import annotations

from dataclasses import replace

from uni4d_fg.pipeline.benchmark.table import Column, Row, Table
from uni4d_fg.pipeline.benchmark.tables import POSED, is_partial

_CHOSEN = (
    ("poses-", {"ATE": "ATE, m", "RPE rot": "RPE rot, deg"}),
    ("depth-", {"AbsRel": "AbsRel", "AbsRel static": "AbsRel static", "AbsRel moving": "AbsRel moving"}),
    ("consistency", {"SC": "SC"}),
    ("points", {"moving median": "moving points, mm"}),
    ("runtime", {"all": "time, s", "failed": "failed"}),
)
"""Beginning of a table's name, and which of its columns are shown under which name."""

_USUAL = "depth-uni4d-scale"
"""One scale per video; the first protocol where this one was not asked for."""


def short_table(title: str, tables: list[Table]) -> Table | None:
    """Return the chosen columns of the first table of every kind; None if there is nothing to show.

    Args:
        title: Name of the dataset.
        tables: All tables.
    """
    columns: list[Column] = []
    rows: dict[str, Row] = {}
    notes = []
    for start, names in _CHOSEN:
        fitting = [t for t in tables if t.name.startswith(start) and not t.name.endswith("-videos")]
        if not fitting:
            continue
        table = next((t for t in fitting if t.name == _USUAL), fitting[0])
        if start in ("poses-", "depth-"):
            notes.append(f"{'poses' if start == 'poses-' else 'depth'}: `{table.name.removeprefix(start)}`")
        if any(is_partial(row) for row in table.rows):  # an error of a part of the frames does not stand alone
            names = {**names, **{column.name: column.name for column in POSED}}
        here = [column for column in table.columns if column.name in names]
        columns += [replace(column, name=names[column.name]) for column in here]
        for row in table.rows:
            if row.kind == "published":  # it is beside the numbers of its own table
                continue
            known = rows.setdefault(row.name, Row(row.name, {}, row.kind, row.source))
            known.values.update({names[column.name]: row.values.get(column.name) for column in here})
    if not rows:
        return None
    return Table("short", f"{title}: in short", "method", columns, list(rows.values()), notes)


def is_detail(table: Table, tables: list[Table]) -> bool:
    """Tell whether a table is left to its own file: depth of every video is shown for one protocol alone."""
    per_video = [t.name for t in tables if t.name.startswith("depth-") and t.name.endswith("-videos")]
    return table.name in per_video[1:]
