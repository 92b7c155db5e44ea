"""Numbers that papers print, to stand beside one's own, marked as what they are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from uni4d_fg.config.yaml_text import parse_yaml
from uni4d_fg.errors import ConfigError
from uni4d_fg.pipeline.benchmark.table import Row
from uni4d_fg.reading import read_text

FILE = Path(__file__).with_name("published.yaml")


@dataclass(frozen=True)
class Published:
    """One row of a printed table."""

    method: str
    dataset: str
    protocol: str
    values: dict[str, float]
    """By name of the column of our tables."""
    source: str
    note: str = ""

    def fits(self, dataset: str, protocol: str) -> bool:
        """Tell whether the row belongs to a dataset, or a variant of it (``sintel-clean``), and a protocol."""
        return protocol == self.protocol and dataset.split("-")[0] == self.dataset.split("-")[0]

    def row(self, dataset: str) -> Row:
        """Return it as a row of a table of a dataset; its source says so if it was printed for another variant."""
        source = f"{self.source}; {self.note}" if self.note else self.source
        if dataset != self.dataset:
            source = f"{source}; printed for `{self.dataset}`, not for `{dataset}`"
        return Row(self.method, dict(self.values), "published", source)


@dataclass(frozen=True)
class _PrintedTable:
    dataset: str
    protocol: str
    columns: list[str]
    source: str
    rows: dict[str, list[float | None]]
    percent: list[str]
    note: str = ""


def read_published(path: Path = FILE) -> list[Published]:
    """Read printed tables: a YAML list of tables with dataset, protocol, source, columns and rows.

    Args:
        path: The file; the package's own by default.

    Raises:
        ConfigError: If it is not of that form.
    """
    try:
        tables = TypeAdapter(list[_PrintedTable]).validate_python(parse_yaml(read_text(path)))
    except (ConfigError, ValidationError) as error:
        what = str(error)
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False, include_input=False)[0]
            what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise ConfigError(f"{path}: is not a list of printed tables ({what})") from error
    rows = []
    for table in tables:
        for method, values in table.rows.items():
            if len(values) != len(table.columns):
                raise ConfigError(f"{path}: {method} on {table.dataset} has {len(values)} numbers for {table.columns}")
            named = {
                column: value / 100.0 if column in table.percent else value
                for column, value in zip(table.columns, values, strict=True)
                if value is not None
            }
            rows.append(Published(method, table.dataset, table.protocol, named, table.source, table.note))
    return rows
