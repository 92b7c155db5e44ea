"""The generated documentation: pages of the configuration, page of the API, tables of variable and factor types.

``python -m uni4d_fg.cli.docs`` in the source checkout writes it, ``--check`` tells whether it is up to date.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from uni4d_fg.cli.api_page import api_page
from uni4d_fg.config import docs as configuration
from uni4d_fg.factors.tables import factors_table, variables_table

COMMAND = "python -m uni4d_fg.cli.docs"
API_PAGE = Path("docs") / "api.md"
CONCEPTS = Path("docs") / "concepts.md"
KERNELS = Path("cpp_factors") / "include" / "uni4d_fg" / "factors"


def main(arguments: list[str] | None = None) -> None:
    """Write the files, or with ``--check`` end with an error if one is out of date."""
    parser = argparse.ArgumentParser(description="Generate the documentation that follows from the code.")
    parser.add_argument("--check", action="store_true", help="only check that it is up to date")
    options = parser.parse_args(arguments)
    if missing := [folder for folder in ("configs", "docs") if not Path(folder).is_dir()]:
        sys.exit(f"there is no folder {missing[0]} here: run this in the source checkout")
    for path, text in files():
        if not options.check:
            path.write_text(text, encoding="utf-8")
        elif not path.exists() or path.read_text(encoding="utf-8") != text:
            sys.exit(f"{path} is out of date: run {COMMAND}")


def files() -> Iterator[tuple[Path, str]]:
    """Yield each file and what it should hold; the preset first, as the pages read it.

    Raises:
        SystemExit: If a page lacks the marks between which a table belongs.
    """
    yield from configuration.files()
    yield API_PAGE, api_page()
    yield CONCEPTS, _with_tables(CONCEPTS, {"variables": variables_table(), "factors": factors_table(KERNELS)})


def _with_tables(path: Path, tables: dict[str, str]) -> str:
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    for name, table in tables.items():
        begin, end = f"<!-- table of {name}: generated -->\n", f"<!-- end of the table of {name} -->"
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if not found or not closed:
            sys.exit(f"{path} has no '{begin.strip()}' followed by '{end}'")
        text = f"{before}{begin}{table}{end}{after}"
    return text


if __name__ == "__main__":
    main()
