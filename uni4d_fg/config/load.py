"""Presets, configuration files and command-line overrides.

A configuration is built in layers, each holding only what it changes: the defaults of the models, a preset
(``configs/*.yaml``), the user's file, and ``FIELD=VALUE`` overrides. Sections are merged field by field.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import yaml

from uni4d_fg.config.base import Section
from uni4d_fg.config.checked import build_section, unknown_field
from uni4d_fg.config.describe import find_field
from uni4d_fg.config.models import Config
from uni4d_fg.config.yaml_text import MAX_YAML_BYTES, parse_yaml
from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.reading import is_present, read_text

SectionT = TypeVar("SectionT", bound=Section)

DEFAULT_PRESET = "default"
_PACKAGE = Path(__file__).resolve().parents[1]
_SUFFIXES = (".yaml", ".yml")


def presets_folder() -> Path:
    """Return the folder of the presets: inside an installed package, or of the source checkout."""
    installed = _PACKAGE / "presets"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"


@cache
def preset_names() -> tuple[str, ...]:
    """Return the names of the presets."""
    return tuple(sorted(path.stem for path in presets_folder().glob("*.yaml")))


def load_config(preset_or_file: str | Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """Build a configuration.

    Args:
        preset_or_file: Name of a preset, or a YAML file with the fields to change and, optionally, the line
            ``preset: NAME`` that names what it changes; None takes the default preset.
        overrides: ``section.field=VALUE``, VALUE in YAML.

    Raises:
        ConfigError: If there is no such preset or file, it is not YAML, or a field is unknown, of the wrong
            type or out of bounds, or fields contradict each other.
    """
    layers: list[tuple[str, dict[str, Any]]] = []
    if preset_or_file is not None and _is_file_name(preset_or_file):
        path = Path(preset_or_file)
        values = _read_yaml(path)
        layers.append((str(path), {k: v for k, v in values.items() if k != "preset"}))
        preset_or_file = _preset_of(path, values)
    name = DEFAULT_PRESET if preset_or_file is None else str(preset_or_file)
    layers.insert(0, (f"preset {name}", _read_yaml(_preset_path(name))))
    return _build(Config, Config(), layers, overrides)


def opened_config(config: Config | str | Path | None, overrides: Sequence[str] = ()) -> Config:
    """Return a configuration as it is, or build what is named, as :func:`load_config` does.

    Raises:
        ConfigError: As :func:`load_config`, or if a configuration that is built already comes with overrides.
    """
    if not isinstance(config, Config):
        return load_config(config, overrides)
    if overrides:
        raise ConfigError("changes: a configuration that is built already takes none; give them to load_config")
    return config


def with_overrides(section: SectionT, overrides: Sequence[str]) -> SectionT:
    """Return a section with ``field=VALUE`` overrides applied.

    Raises:
        ConfigError: As :func:`load_config`.
    """
    return _build(type(section), section, [], overrides)


def dump_config(config: Section) -> str:
    """Return a configuration as YAML, every field included; reading it back gives the same configuration."""
    text: str = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, width=120)
    return text


def _build(
    model: type[SectionT], start: SectionT, layers: list[tuple[str, dict[str, Any]]], overrides: Sequence[str]
) -> SectionT:
    if isinstance(overrides, str):
        raise ConfigError(f"changes: a list of section.field=VALUE is expected, such as [{overrides!r}], not one text")
    values: dict[str, Any] = start.model_dump(mode="json")
    sources: list[tuple[tuple[str, ...], str]] = []
    for source, layer in layers:
        _merge(values, layer)
        sources += [(path, source) for path in _leaves(layer)]
    for text in overrides:
        path, value = _parse_override(model, text)
        layer = value
        for part in reversed(path):
            layer = {part: layer}
        _merge(values, layer)
        sources.append((path, "--set"))

    def source_of(path: tuple[str, ...]) -> str:
        for known, source in reversed(sources):
            if known[: len(path)] == path or path[: len(known)] == known:
                return source
        return "configuration"

    return build_section(model, values, source_of)


def _parse_override(model: type[Section], text: str) -> tuple[tuple[str, ...], Any]:
    """Return the path of names and the value of ``a.b=VALUE``."""
    dotted, separator, value = text.partition("=")
    path = tuple(part.strip() for part in dotted.split("."))
    if not separator or not all(path):
        raise ConfigError(f"--set {text}: give it as section.field=VALUE")
    if find_field(model, path) is None:
        raise ConfigError(f"--set: {unknown_field(model, path)}")
    try:
        return path, parse_yaml(value)
    except ConfigError as error:
        shown = repr(value) if len(value) <= 60 else f"{value[:57]!r}..."
        raise ConfigError(f"--set {dotted}: {shown} is not a YAML value ({error})") from error


def _merge(base: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Put ``changes`` over ``base`` in place; an empty section changes nothing."""
    for key, value in changes.items():
        old = base.get(key)
        if isinstance(old, dict) and isinstance(value, Mapping):
            _merge(old, value)
        elif not (isinstance(old, dict) and value is None):
            base[key] = value


def _leaves(values: Mapping[Any, Any], prefix: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    out: list[tuple[str, ...]] = []
    for key, value in values.items():
        path = (*prefix, str(key))
        out += _leaves(value, path) if isinstance(value, Mapping) and value else [path]
    return out


def _is_file_name(preset_or_file: str | Path) -> bool:
    if isinstance(preset_or_file, Path):
        return True
    if preset_or_file in preset_names():
        return False
    path = Path(preset_or_file)
    return path.suffix.lower() in _SUFFIXES or len(path.parts) > 1 or _is_there(path)


def _is_there(path: Path) -> bool:
    try:
        return is_present(path)
    except InputError as error:
        raise ConfigError(str(error)) from error


def _preset_of(path: Path, values: Mapping[str, Any]) -> str | None:
    name = values.get("preset")
    if name is not None and not isinstance(name, str):
        raise ConfigError(f"{path}: preset: got {name!r}, but one of {', '.join(preset_names())} is expected")
    return name


def _preset_path(name: str) -> Path:
    path = presets_folder() / f"{name}.yaml"
    if name not in preset_names():
        close = difflib.get_close_matches(name, preset_names(), n=1)
        meant = f"did you mean {close[0]}? " if close else ""
        raise ConfigError(
            f"{name}: no such preset or file; {meant}presets: {', '.join(preset_names())}; a file's name ends in .yaml"
        )
    return path


def read_yaml(path: Path) -> Any:
    """Return the values in a YAML file.

    Raises:
        ConfigError: If it cannot be read, or is no YAML as configurations need it.
    """
    try:
        text = read_text(path, MAX_YAML_BYTES, "a YAML file")
    except InputError as error:
        raise ConfigError(str(error)) from error
    try:
        return parse_yaml(text)
    except ConfigError as error:
        raise ConfigError(f"{path}: not valid YAML: {error}") from error


def _read_yaml(path: Path) -> dict[str, Any]:
    values = read_yaml(path)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: holds {type(values).__name__}, but a mapping of sections is expected")
    return values
