"""The pages about the configuration and the preset ``default``, generated from the models.

``python -m uni4d_fg.cli.docs`` in the source checkout writes them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from uni4d_fg.config.base import Section
from uni4d_fg.config.describe import FieldDescription, describe_fields, section_type
from uni4d_fg.config.load import load_config, preset_names, presets_folder
from uni4d_fg.config.models import Config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.config.written import commented_yaml

PAGE = Path("docs") / "configuration.md"
ADVANCED_PAGE = Path("docs") / "configuration_advanced.md"
DEFAULT_PRESET = Path("configs") / "default.yaml"

_HEAD = """# Configuration

This page is generated from the models in `uni4d_fg/config`; `python -m uni4d_fg.cli.docs` writes it anew.

A configuration is built in layers, and each layer holds only what it changes:

1. the defaults,
2. a preset: {presets},
3. your own YAML file, which may name the preset that it changes in the line `preset: NAME`,
4. `--set section.field=VALUE` on the command line, with VALUE in YAML.

```bash
uni4d-fg reconstruct SEQ --out RUN --config paper --set nonrigid.neighbors=8
uni4d-fg config --config mine.yaml        # print the configuration as it would be used; --all for every field
```

The {count} fields below are those that a user turns; `configs/default.yaml` writes them out with their values, to be
copied and changed. The method's own numbers are fields too, {others} of them, on the
[advanced page](configuration_advanced.md).

A field that does not exist, a value of the wrong type and a value out of bounds are refused with the name of
the field, the value given and the values allowed. Every run saves the whole configuration it used as
`RUN/config.yaml`, and that file can be given to `--config` again. The two energies are not to be mixed: kernels of
kind `norm` belong to `energy: paper`, which has neither depth priors nor measured noise. `--config paper` takes it
whole, and its weights, thresholds and annealing may be changed from there.
"""

_ADVANCED_HEAD = """# Advanced configuration

This page is generated from the models in `uni4d_fg/config`; `python -m uni4d_fg.cli.docs` writes it anew.

These are the method's own numbers: fields with bounds like those of [configuration.md](configuration.md), which seldom
need another value. `uni4d-fg config --all` prints them with the others.
"""

_DEFAULT_HEAD = """\
# A maximum a posteriori estimate with noise measured on the static scene.
#
# It changes nothing: these are the defaults of the fields that a user turns (docs/configuration.md). The method's own
# numbers are on docs/configuration_advanced.md. `python -m uni4d_fg.cli.docs` writes this file anew.
# A file of your own holds only the fields you change, for example:
#
#   preset: default
#   tracking:
#     query_interval: 5
#   nonrigid:
#     smoothness_sigma_m: 0.01

"""


def configuration_page() -> str:
    """Return the page of the basic fields as Markdown."""
    fields = list(describe_fields(Config()))
    basic = [field for field in fields if field.basic]
    presets = ", ".join(f"`{name}`" for name in preset_names())
    head = _HEAD.format(presets=presets, count=len(basic), others=len(fields) - len(basic))
    parts = [head, "## Presets\n", _presets_list(), "## Fields\n"]
    titles = {"": ("General", "")}
    titles |= {name: (f"`{name}`", field.description or "") for name, field in Config.model_fields.items()}
    groups: dict[str, list[FieldDescription]] = {}
    for field in basic:
        groups.setdefault(field.path.rpartition(".")[0].partition(".")[0], []).append(field)
    for name, group in groups.items():
        parts.append(_fields_table(*titles[name], group, f"{name}."))
    return "\n".join(parts)


def advanced_page() -> str:
    """Return the page of all other fields as Markdown."""
    parts = [_ADVANCED_HEAD, "## Fields\n"]
    advanced = {field.path for field in describe_fields(Config()) if not field.basic}
    parts += _sections(Config(), "", 3, advanced.__contains__)
    parts.append("## What the presets change\n\n" + _presets_table())
    scene = SyntheticSceneConfig()
    parts.append(
        "## Synthetic scene\n\nWhat `uni4d-fg synthesize` and `uni4d-fg demo` make. "
        "Fields are set with `synthesize --set FIELD=VALUE`; they are not part of a run's configuration.\n"
    )
    parts += _sections(scene, "", 3, lambda path: True)
    return "\n".join(parts)


def default_preset() -> str:
    """Return the preset ``default``: every basic field with its default."""
    return _DEFAULT_HEAD + commented_yaml(field for field in describe_fields(Config()) if field.basic)


def files() -> Iterator[tuple[Path, str]]:
    """Yield each file and what it should hold; the preset first, as the pages read it."""
    yield DEFAULT_PRESET, default_preset()
    yield PAGE, configuration_page()
    yield ADVANCED_PAGE, advanced_page()


def _presets_list() -> str:
    """Return what each preset says of itself at its beginning."""
    lines = []
    for name in preset_names():
        said = []
        for line in (presets_folder() / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
            if not line.removeprefix("#").strip() or not line.startswith("#"):
                break
            said.append(line.removeprefix("#").strip())
        lines.append(f"- `{name}`: {' '.join(said)}")
    return "\n".join(lines) + "\n"


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


def _sections(section: Section, prefix: str, level: int, wanted: Callable[[str], bool]) -> list[str]:
    """Return a table of the wanted fields of a section itself, then those of the sections in it."""
    own = [field for field in describe_fields(section, prefix) if "." not in field.path.removeprefix(prefix)]
    out: list[str] = []
    if not prefix and any(wanted(field.path) for field in own):
        out.append(_fields_table("General", "", [field for field in own if wanted(field.path)], "", level))
    for name, field in type(section).model_fields.items():
        if section_type(field) is None:
            continue
        value: Section = getattr(section, name)
        path = f"{prefix}{name}."
        inner = [f for f in describe_fields(value, path) if wanted(f.path)]
        if not inner:
            continue
        here = [f for f in inner if "." not in f.path.removeprefix(path)]
        out.append(_fields_table(f"`{path[:-1]}`", field.description or "", here, path, level))
        out += _sections(value, path, min(level + 1, 5), wanted)
    return out


def _fields_table(title: str, text: str, fields: list[FieldDescription], prefix: str, level: int = 3) -> str:
    """Return a table of fields, whose names are their paths without the prefix."""
    lines = [f"{'#' * level} {title}", ""]
    if text:
        lines += [text, ""]
    if fields:
        lines += ["| field | default | allowed | meaning |", "|---|---|---|---|"]
    for field in fields:
        name = field.path.removeprefix(prefix)
        lines.append(f"| `{name}` | {_value(field.default)} | {field.allowed} | {field.description} |")
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, str):
        return f"`{value}`"
    return f"`{json.dumps(value)}`"
