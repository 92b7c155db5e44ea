"""Configurations as YAML with a comment above every field: ``configs/default.yaml`` and what the command prints."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

import yaml

from uni4d_fg.config.base import Section
from uni4d_fg.config.describe import FieldDescription, describe_fields

_WIDTH = 120
_STEP = "  "


def commented_yaml(fields: Iterable[FieldDescription]) -> str:
    """Return fields as YAML, each below its description; those of a section must follow each other."""
    lines: list[str] = []
    open_sections: list[str] = []
    for field in fields:
        *sections, name = field.path.split(".")
        known = 0
        while known < min(len(sections), len(open_sections)) and sections[known] == open_sections[known]:
            known += 1
        if lines and sections[:1] != open_sections[:1]:
            lines.append("")
        lines += [f"{_STEP * depth}{sections[depth]}:" for depth in range(known, len(sections))]
        open_sections, indent = sections, _STEP * len(sections)
        lines += textwrap.wrap(field.description, _WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
        value = list(field.default) if isinstance(field.default, tuple) else field.default
        in_a_list: str = yaml.safe_dump([value], default_flow_style=True, width=10**6)
        lines.append(f"{indent}{name}: {in_a_list.rstrip()[1:-1]}")
    return "\n".join([*lines, ""])


def basic_fields(section: Section) -> list[FieldDescription]:
    """Return the fields that a user turns, and of the others those that are not at their default.

    Reading them back gives the same configuration.
    """
    default = {field.path: field.default for field in describe_fields(type(section)())}
    return [field for field in describe_fields(section) if field.basic or field.default != default[field.path]]
