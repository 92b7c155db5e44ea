"""From plain values to a configuration model, with messages that name the field and what it takes."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from uni4d_fg.config.base import Section
from uni4d_fg.config.describe import allowed_values, field_paths, find_field, section_type
from uni4d_fg.errors import ConfigError

SectionT = TypeVar("SectionT", bound=Section)

_MAX_LISTED = 5


def build_section(
    model: type[SectionT],
    values: Mapping[str, Any],
    source_of: Callable[[tuple[str, ...]], str] = lambda path: "configuration",
) -> SectionT:
    """Check plain values and build a model from them; numbers are not made from text or booleans.

    Args:
        model: What to build.
        values: Nested mappings as a YAML file gives them.
        source_of: Tells where the value at a path of names came from, for the messages.

    Raises:
        ConfigError: With every problem found (at most five): source, dotted path, value given, values allowed.
    """
    problems = list(_not_plain(values, ()))
    plain, count = not problems, len(problems)
    if plain:
        try:
            # JSON is strict about types but lets a list become a tuple.
            return model.model_validate_json(json.dumps(values), strict=True)
        except ValidationError as error:
            found = error.errors(include_url=False)
            # Only what is said is worked out: the names nearest to thousands of unknown ones take minutes.
            problems, count = [_problem(model, detail) for detail in found[:_MAX_LISTED]], len(found)
        except (ValueError, RecursionError) as error:
            problems, count = [((), f"a value cannot be used ({error})")], 1
    # Fields that contradict each other may come from several sources.
    texts = [text if plain and not path else f"{source_of(path)}: {text}" for path, text in problems[:_MAX_LISTED]]
    if count > _MAX_LISTED:
        texts.append(f"and {count - _MAX_LISTED} more")
    raise ConfigError("; ".join(texts))


def unknown_field(model: type[Section], path: tuple[str, ...]) -> str:
    """Say that a field does not exist, and which one may have been meant."""
    dotted, parent = ".".join(path), ".".join(path[:-1])
    known = list(field_paths(model))
    siblings = [p.rpartition(".")[2] for p in known if p.rpartition(".")[0] == parent]
    close = difflib.get_close_matches(path[-1], siblings, n=1, cutoff=0.6)
    same_name = [p for p in known if p.rpartition(".")[2] == path[-1]]
    nearest = difflib.get_close_matches(path[-1], siblings, n=1, cutoff=0.0)
    if close:
        return f"{dotted}: unknown field, did you mean {'.'.join((*path[:-1], close[0]))}?"
    if same_name:
        return f"{dotted}: unknown field, did you mean {same_name[0]}?"
    if nearest:
        return f"{dotted}: unknown field, the closest name is {'.'.join((*path[:-1], nearest[0]))}"
    whole = difflib.get_close_matches(dotted, known, n=1, cutoff=0.0)
    return f"{dotted}: unknown field, the closest name is {whole[0]}"


def _not_plain(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield what JSON cannot carry: NaN, infinities, dates and keys that are not text."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if isinstance(key, str):
                yield from _not_plain(item, (*path, key))
            else:
                yield path, f"{'.'.join((*path, str(key)))}: a field name must be a text, got {_shown(key)}"
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _not_plain(item, path)
    elif isinstance(value, float) and not math.isfinite(value):
        yield path, f"{'.'.join(path)}: got {value}, but only finite numbers are allowed"
    elif value is not None and not isinstance(value, (str, int, float, bool)):
        yield path, f"{'.'.join(path)}: got {_shown(value)}, which is no number, text, list or mapping"


def _problem(model: type[Section], detail: Any) -> tuple[tuple[str, ...], str]:
    """Return the path of names and the text of one pydantic error."""
    names = tuple(str(part) for part in detail["loc"] if not isinstance(part, int))
    if detail["type"] == "extra_forbidden":
        return names, unknown_field(model, names)
    field = find_field(model, names)
    if field is None or detail["type"] == "value_error":
        return names, ": ".join([*([".".join(names)] if names else []), detail["msg"].removeprefix("Value error, ")])
    if detail["type"] == "missing":
        return names, f"{'.'.join(names)}: is missing, but {allowed_values(field)} is expected"
    entry = " in the list" if any(isinstance(part, int) for part in detail["loc"]) else ""
    given = f"{'.'.join(names)}: got {_shown(detail['input'])}{entry}"
    if section_type(field) is not None:
        return names, f"{given}, but it is {allowed_values(field)}"
    return names, f"{given}, but {allowed_values(field)} is expected"


def _shown(value: Any) -> str:
    text = json.dumps(value, default=str, skipkeys=True)
    return text if len(text) <= 60 else f"{text[:57]}..."
