"""Typed configuration: pydantic models of runs and synthetic scenes, YAML presets, command-line overrides."""

from uni4d_fg.config.models import Config

__all__ = ["Config"]
