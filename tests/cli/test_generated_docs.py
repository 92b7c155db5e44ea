"""The generated documentation: up to date in the checkout, complete, and refused when it is not."""

from __future__ import annotations

import dataclasses
import inspect
import re
from pathlib import Path

import pytest

import uni4d_fg
from uni4d_fg.cli import docs
from uni4d_fg.cli.api_page import api_page
from uni4d_fg.factors.factor_type import factor_types
from uni4d_fg.factors.tables import factors_table, variables_table
from uni4d_fg.factors.variable import variable_types

CHECKOUT = Path(__file__).resolve().parents[2]


def test_everything_generated_is_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(CHECKOUT)
    docs.main(["--check"])


def test_every_public_name_method_and_field_is_on_the_page() -> None:
    page = api_page()
    for name in uni4d_fg.__all__:
        assert f"\n## {name}\n" in page
        value = getattr(uni4d_fg, name)
        if not inspect.isclass(value):
            continue
        fields = [f.name for f in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else []
        for field in fields:
            assert f"\n- `{field}: " in page, f"{name}.{field}"
        for member, what in vars(value).items():
            described = callable(what) or isinstance(what, classmethod | property)
            if described and not member.startswith("_") and member not in fields:
                assert f"\n### {name}.{member}\n" in page, f"{name}.{member}"


def test_every_public_name_says_what_it_is() -> None:
    sections = api_page().split("\n## ")[1:]
    assert len(sections) == len(uni4d_fg.__all__)
    for section in sections:
        text = re.sub(r"```.*?```", "", section, flags=re.DOTALL)
        prose = [part for part in text.split("\n\n")[1:] if part.strip()[:1].isupper()]
        assert prose, section[:200]
        assert prose[0].rstrip().endswith((".", ":")), section[:200]


def test_a_docstring_becomes_markdown() -> None:
    page = api_page()
    assert "- `overrides`: `section.field=VALUE`, VALUE in YAML." in page
    assert ":class:" not in page
    assert "``" not in page.replace("```", "")


def test_the_tables_hold_every_declared_type() -> None:
    factors = factors_table(CHECKOUT / docs.KERNELS)
    for kind in factor_types():
        if kind.residual.__module__.startswith("uni4d_fg.factors."):
            assert factors.count(f"\n| `{kind.name}` |") == 1
    assert (
        "| `static_reprojection` | `x l k` | uv (2) | 2 | analytic | yes | yes | `static_reprojection.py` |" in factors
    )
    assert "| `scale_anchor` | `x x` | distance | 1 | analytic | no | no | `priors.py` |" in factors
    variables = variables_table()
    own = {v.name for v in vars(uni4d_fg.variables).values() if v in variable_types()}
    assert len(own) >= 9
    assert all(f"\n| `{name}` |" in variables for name in own)
    assert "| `object_pose` | `o(instance, frame)` | 4 x 4 | SE3, 6 | `OBJECT_POSE` |" in variables


def test_a_page_out_of_date_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="source checkout"):
        docs.main([])
    for folder in ("configs", "docs"):
        (tmp_path / folder).mkdir()
    with pytest.raises(SystemExit, match="out of date"):
        docs.main(["--check"])
    with pytest.raises(SystemExit, match=r"concepts\.md has no '<!-- table of variables"):
        docs.main([])
    docs.CONCEPTS.write_text((CHECKOUT / docs.CONCEPTS).read_text(encoding="utf-8"), encoding="utf-8")
    docs.main([])
    docs.main(["--check"])
    docs.API_PAGE.write_text("changed", encoding="utf-8")
    with pytest.raises(SystemExit, match=r"api\.md is out of date"):
        docs.main(["--check"])
