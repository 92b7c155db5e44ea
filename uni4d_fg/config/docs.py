"""The page ``docs/configuration.md``, generated from the models.

``python -m uni4d_fg.config.docs`` in the source checkout writes it, ``--check`` tells whether it is up to date.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from uni4d_fg.config.base import Section
from uni4d_fg.config.describe import FieldDescription, describe_fields, section_type
from uni4d_fg.config.load import load_config, preset_names
from uni4d_fg.config.models import Config
from uni4d_fg.synthetic.config import SyntheticSceneConfig

PAGE = Path("docs") / "configuration.md"

_HEAD = """# Configuration

This page is generated from the models in `uni4d_fg/config`; `python -m uni4d_fg.config.docs` writes it anew.

A configuration is built in layers, and each layer holds only what it changes:

1. the defaults below,
2. a preset: {presets},
3. your own YAML file, which may name the preset that it changes in the line `preset: NAME`,
4. `--set section.field=VALUE` on the command line, with VALUE in YAML.

```bash
uni4d-fg reconstruct SEQ --out RUN --config paper --set nonrigid.neighbours=8
uni4d-fg config --config mine.yaml        # print all fields as they would be used
```

A field that does not exist, a value of the wrong type and a value out of bounds are refused with the name of
the field, the value given and the values allowed. Every run saves the whole configuration it used as
`RUN/config.yaml`, and that file can be given to `--config` again.
"""


def configuration_page() -> str:
    """Return the page as Markdown."""
    presets = ", ".join(f"`{name}`" for name in preset_names())
    parts = [_HEAD.format(presets=presets), "## Presets\n\n" + _presets_table(), "## Fields\n"]
    parts.append(_fields_table("General", "", _own_fields(Config(), "")))
    parts += _sections(Config(), "", level=3)
    scene = SyntheticSceneConfig()
    parts.append(
        "## Synthetic scene\n\nWhat `uni4d-fg synthesize` and `uni4d-fg demo` make. "
        "Fields are set with `synthesize --set FIELD=VALUE`; they are not part of a run's configuration.\n"
    )
    parts.append(_fields_table("Scene", "", _own_fields(scene, "")))
    parts += _sections(scene, "", level=3)
    return "\n".join(parts)


def main(arguments: list[str] | None = None) -> None:
    """Write the page, or with ``--check`` end with an error if it is out of date."""
    parser = argparse.ArgumentParser(description="Generate docs/configuration.md.")
    parser.add_argument("--check", action="store_true", help="only check that the page is up to date")
    options = parser.parse_args(arguments)
    text = configuration_page()
    if not PAGE.parent.is_dir():
        sys.exit(f"there is no folder {PAGE.parent} here: run this in the source checkout")
    if not options.check:
        PAGE.write_text(text, encoding="utf-8")
    elif not PAGE.exists() or PAGE.read_text(encoding="utf-8") != text:
        sys.exit(f"{PAGE} is out of date: run python -m uni4d_fg.config.docs")


def _presets_table() -> str:
    """Return what each preset changes."""
    default = {field.path: field for field in describe_fields(load_config())}
    lines = ["| field | " + " | ".join(f"`{name}`" for name in preset_names()) + " |"]
    lines.append("|---" * (1 + len(preset_names())) + "|")
    chosen = {name: {f.path: f.default for f in describe_fields(load_config(name))} for name in preset_names()}
    for path, field in default.items():
        values = [chosen[name][path] for name in preset_names()]
        if any(value != field.default for value in values):
            lines.append(f"| `{path}` | " + " | ".join(_value(value) for value in values) + " |")
    return "\n".join(lines) + "\n"


def _own_fields(section: Section, prefix: str) -> list[FieldDescription]:
    """Return the fields of a section that are not sections themselves."""
    return [field for field in describe_fields(section, prefix) if "." not in field.path.removeprefix(prefix)]


def _sections(section: Section, prefix: str, level: int) -> list[str]:
    out: list[str] = []
    for name, field in type(section).model_fields.items():
        if section_type(field) is None:
            continue
        value: Section = getattr(section, name)
        path = f"{prefix}{name}."
        out.append(_fields_table(f"`{path[:-1]}`", field.description or "", _own_fields(value, path), level))
        out += _sections(value, path, min(level + 1, 5))
    return out


def _fields_table(title: str, text: str, fields: list[FieldDescription], level: int = 3) -> str:
    lines = [f"{'#' * level} {title}", ""]
    if text:
        lines += [text, ""]
    if fields:
        lines += ["| field | default | allowed | meaning |", "|---|---|---|---|"]
    for field in fields:
        name = field.path.rpartition(".")[2]
        lines.append(f"| `{name}` | {_value(field.default)} | {field.allowed} | {field.description} |")
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, str):
        return f"`{value}`"
    return f"`{json.dumps(value)}`"


if __name__ == "__main__":
    main()
