"""What a configuration model accepts, in words: shared by error messages and the documentation page."""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from uni4d_fg.config.base import Section, is_basic

_TYPE_TEXT = {int: "an integer", float: "a number", bool: "true or false", str: "a text"}
_BOUND_TEXT = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}


@dataclass(frozen=True)
class FieldDescription:
    """One field that is not a section itself."""

    path: str
    """Dotted path from the top."""
    allowed: str
    """Type and bounds in words."""
    default: Any
    description: str
    basic: bool = True
    """Whether it is one that a user turns; the other fields are the method's own numbers."""


def section_type(field: FieldInfo) -> type[Section] | None:
    """Return the model of a field that is a section, else None."""
    annotation = field.annotation
    return annotation if isinstance(annotation, type) and issubclass(annotation, Section) else None


def find_field(model: type[Section], path: tuple[str, ...]) -> FieldInfo | None:
    """Return the field at a path of names, or None if there is none."""
    field: FieldInfo | None = None
    section: type[Section] | None = model
    for name in path:
        if section is None or name not in section.model_fields:
            return None
        field = section.model_fields[name]
        section = section_type(field)
    return field


def allowed_values(field: FieldInfo) -> str:
    """Say which values a field takes: "an integer, at least 2"."""
    section = section_type(field)
    if section is not None:
        return f"a section with the fields {', '.join(section.model_fields)}"
    bounds = [
        f"{text} {getattr(constraint, name):g}"
        for constraint in field.metadata
        for name, text in _BOUND_TEXT.items()
        if getattr(constraint, name, None) is not None
    ]
    kind, nullable = _annotation_text(field.annotation)
    text = f"{kind} {' and '.join(bounds)}" if bounds else kind
    return f"{text}, or null" if nullable else text


def _annotation_text(annotation: Any) -> tuple[str, bool]:
    """Return a type in words, and whether null is allowed too."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        texts = [_annotation_text(argument)[0] for argument in arguments if argument is not type(None)]
        return " or ".join(texts), type(None) in arguments
    if origin is Literal:
        return f"one of {', '.join(map(str, arguments))}", False
    if origin is tuple:
        return ("a list of texts" if str in arguments else "a list of numbers"), False
    return _TYPE_TEXT.get(annotation, str(annotation)), False


def describe_fields(model: Section, prefix: str = "", *, basic: bool = True) -> Iterator[FieldDescription]:
    """Yield every field of a section and of the sections in it, with its value in ``model`` as default.

    Args:
        model: The section.
        prefix: Put before every path.
        basic: Whether the section itself is one that a user turns.
    """
    for name, field in type(model).model_fields.items():
        value, kind = getattr(model, name), basic and is_basic(field)
        if isinstance(value, Section):
            yield from describe_fields(value, f"{prefix}{name}.", basic=kind)
        else:
            yield FieldDescription(f"{prefix}{name}", allowed_values(field), value, field.description or "", kind)


def field_paths(model: type[Section], prefix: str = "") -> Iterator[str]:
    """Yield the dotted path of every section and field."""
    for name, field in model.model_fields.items():
        yield f"{prefix}{name}"
        section = section_type(field)
        if section is not None:
            yield from field_paths(section, f"{prefix}{name}.")
