"""Values that YAML 1.1 takes for booleans."""

from __future__ import annotations

import pytest

from uni4d_fg.config.load import load_config
from uni4d_fg.config.yaml_text import parse_yaml


@pytest.mark.parametrize("value", ["on", "off"])
def test_on_and_off_are_text(value: str) -> None:
    assert load_config("default", [f"camera.zoom={value}"]).camera.zoom == value
    assert parse_yaml(f"a: {value}") == {"a": value}


def test_off_of_shots() -> None:
    assert load_config("default", ["shots.split=off"]).shots.split == "off"


@pytest.mark.parametrize(("text", "value"), [("true", True), ("False", False), ("yes", True), ("no", False)])
def test_booleans_stay(text: str, value: bool) -> None:
    assert parse_yaml(f"a: {text}") == {"a": value}
