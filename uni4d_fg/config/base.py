"""The base of every configuration section."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict
from pydantic import Field as _Field
from pydantic.fields import FieldInfo


class Section(BaseModel):
    """A frozen group of fields: unknown names are refused, every field has bounds and a description."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


def setting(default: Any, description: str, *, basic: bool = False, **bounds: Any) -> Any:
    """Declare one field.

    Args:
        default: Its value where nothing else is said.
        description: What it means, with its unit.
        basic: It is among the fields that a user turns: written out in ``configs/default.yaml`` and described on the
            first page. The fields of a section count as basic only where the section is.
        bounds: ``ge``, ``gt``, ...
    """
    return _Field(default=default, description=description, json_schema_extra={"basic": basic}, **bounds)


def is_basic(field: FieldInfo) -> bool:
    """Return whether a field was declared as basic."""
    extra = field.json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("basic"))
