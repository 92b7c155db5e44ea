"""The base of every configuration section."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict
from pydantic import Field as _Field


class Section(BaseModel):
    """A frozen group of fields: unknown names are refused, every field has bounds and a description."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


def setting(default: Any, description: str, **bounds: Any) -> Any:
    """Declare one field: its default, what it means (with its unit), and its bounds (``ge``, ``gt``, ...)."""
    return _Field(default=default, description=description, **bounds)
