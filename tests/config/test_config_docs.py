"""The generated pages of the configuration, and the preset that writes the basic fields out."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from uni4d_fg.config import docs
from uni4d_fg.config.describe import describe_fields
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.config.written import basic_fields, commented_yaml


def test_every_field_stands_on_one_of_the_pages() -> None:
    basic, advanced = docs.configuration_page(), docs.advanced_page()
    for field in describe_fields(Config()):
        section, _, name = field.path.partition(".")
        if field.basic:
            assert f"| `{name or section}` |" in basic, field.path
        else:
            assert f"| `{field.path.rpartition('.')[2]}` |" in advanced, field.path


def test_the_default_preset_writes_about_sixty_fields_out_and_changes_none() -> None:
    written = {field.path: field.default for field in describe_fields(Config()) if field.basic}
    assert 55 <= len(written) <= 70
    assert load_config("default") == Config()
    found: dict[str, object] = {}
    pending = [("", yaml.safe_load(docs.default_preset()))]
    while pending:
        prefix, section = pending.pop()
        for name, value in section.items():
            if isinstance(value, dict):
                pending.append((f"{prefix}{name}.", value))
            else:
                found[f"{prefix}{name}"] = tuple(value) if isinstance(value, list) else value
    assert found == written


@pytest.mark.parametrize("name", ["default", "fast", "paper"])
def test_what_is_printed_without_the_untouched_advanced_fields_reads_back_the_same(name: str, tmp_path: Path) -> None:
    config = load_config(name, ["nonrigid.solver.relative_decrease=1e-5", "camera_init.window=6"])
    (tmp_path / "mine.yaml").write_text(commented_yaml(basic_fields(config)), encoding="utf-8")
    assert load_config(tmp_path / "mine.yaml") == config
    assert len(basic_fields(load_config("default"))) <= 70
