"""The generated page of the configuration."""

from __future__ import annotations

from pathlib import Path

import pytest

from uni4d_fg.config import docs
from uni4d_fg.config.describe import describe_fields
from uni4d_fg.config.models import Config

CHECKOUT = Path(__file__).resolve().parents[2]


def test_the_page_is_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(CHECKOUT)
    docs.main(["--check"])


def test_the_page_names_every_field() -> None:
    page = docs.configuration_page()
    for field in describe_fields(Config()):
        assert f"| `{field.path.rpartition('.')[2]}` |" in page


def test_a_page_out_of_date_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="source checkout"):
        docs.main([])
    (tmp_path / "docs").mkdir()
    with pytest.raises(SystemExit, match="out of date"):
        docs.main(["--check"])
    docs.main([])
    docs.main(["--check"])
