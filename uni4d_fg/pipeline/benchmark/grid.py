"""Rows of the tables from a YAML file: configurations by name, and all combinations of what varies.

base: {preset: default, set: [output.pictures=false]}
rows:
  default: {}
  without ARAP: {set: [nonrigid.arap_weight=0]}
  known intrinsics: {intrinsics: known}
grid:
  solver: [lm, adam]          # fields of the configuration, or preset, intrinsics, depth, masks, tracks, poses
  preset: [default, paper]

Three lists of rows are ready made, see :data:`READY_MADE`.
"""

from __future__ import annotations

import importlib.util
import itertools
import math
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from uni4d_fg.config.load import load_config
from uni4d_fg.config.yaml_text import parse_yaml
from uni4d_fg.errors import ConfigError
from uni4d_fg.pipeline.benchmark.task import Configuration, Masks, check_names
from uni4d_fg.reading import read_text

PAPER: dict[str, dict[str, Any]] = {
    "all": {},
    "from cameras at rest (stage 2 only)": {"poses": "identity"},
    "without E_NR": {"set": ["nonrigid.reprojection=false"]},
    "without ARAP": {"set": ["nonrigid.arap_weight=0"]},
    "without smoothness": {"set": ["nonrigid.smoothness_weight=0"]},
    "known intrinsics": {"intrinsics": "known"},
    "built-in tracker": {"tracks": "built_in"},
    "masks from motion": {"masks": "motion"},
    "no masks": {"masks": "none"},
    "depth from motion": {"depth": "motion"},
}
"""The paper's ablations as far as no other network is needed."""

_STANDARD: dict[str, dict[str, Any]] = {
    **PAPER,
    "without E_cam": {
        "set": ["bundle_adjustment.acceleration.linear=null", "bundle_adjustment.acceleration.angular=null"]
    },
    "preset paper": {"preset": "paper"},
}

READY_MADE: dict[str, dict[str, dict[str, Any]]] = {
    "paper": PAPER,
    "standard": _STANDARD,
    "full": {
        **_STANDARD,
        "without the depth prior": {
            "set": ["bundle_adjustment.depth_prior=false", "nonrigid.depth_prior=false"],
        },
        "true masks": {"masks": "true"},
        "preset fast": {"preset": "fast"},
        "preset paper, formulas of the text": {
            "preset": "paper",
            "set": [
                "normalization=sum",
                "camera_init.kernel={kind: quadratic}",
                "camera_init.camera_motion={rotation_weight: 0, translation_weight: 0}",
                "bundle_adjustment.camera_motion.translation_axes=camera",
                "fusion.distance_power=1",
                "fusion.averaged_scale=linear",
            ],
        },
        "Adam": {"set": ["solver=adam"]},
        "preset paper, Adam": {"preset": "paper", "set": ["solver=adam"]},
    },
}
"""Rows by the name that ``uni4d-fg ablate --rows`` takes, 'standard' if not given. Adam, which needs PyTorch and takes
minutes a video, is in the last list only."""

_MOST_ROWS = 500


class _Way(BaseModel):
    """What a row may say."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    preset: str = "default"
    set: tuple[str, ...] = ()
    intrinsics: Literal["unknown", "known"] = "unknown"
    depth: Literal["cue", "motion"] = "cue"
    masks: Masks = "cue"
    tracks: Literal["cue", "built_in"] = "cue"
    poses: Literal["estimate", "identity"] = "estimate"

    def named(self, name: str) -> Configuration:
        return Configuration(
            name, self.preset, self.set, self.intrinsics, self.depth, self.masks, self.tracks, self.poses
        )


class _File(BaseModel):
    """A whole file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    base: dict[str, Any] = {}
    rows: dict[str, dict[str, Any] | None] = {}
    grid: dict[str, list[Any]] = {}


def read_grid(path: Path) -> list[Configuration]:
    """Read configurations, and make sure that each is a valid one.

    Raises:
        InputError: If the file cannot be read.
        ConfigError: If it is not of that form, a field is unknown, a value not allowed, or a name used twice.
    """
    try:
        found = _File.model_validate(parse_yaml(read_text(path)) or {})
    except (ConfigError, ValidationError) as error:
        raise ConfigError(f"{path}: is not a list of configurations ({_said(error)})") from error
    count = len(found.rows) + (math.prod(map(len, found.grid.values())) if found.grid else 0)
    if not count:
        raise ConfigError(f"{path}: has neither rows nor a grid; name at least one configuration")
    if count > _MOST_ROWS:
        raise ConfigError(f"{path}: makes {count} configurations, at most {_MOST_ROWS} are run; split it")
    named = [(name, row or {}) for name, row in found.rows.items()]
    for values in itertools.product(*found.grid.values()):
        if values:
            named.append(_combination(dict(zip(found.grid, values, strict=True))))
    return configurations(named, found.base, str(path))


def ready_made(name: str, base: dict[str, Any]) -> tuple[list[Configuration], list[str]]:
    """Return the configurations of a ready-made list, and the names of those that are left out without PyTorch.

    Raises:
        ConfigError: If there is no such list, or what ``base`` changes does not go with one of its rows.
    """
    if name not in READY_MADE:
        raise ConfigError(f"--rows {name[:60]}: choose one of {', '.join(READY_MADE)}, or give a file with rows")
    rows = configurations(list(READY_MADE[name].items()), base, f"--rows {name}")
    if importlib.util.find_spec("torch") is not None:
        return rows, []
    return [r for r in rows if not _by_adam(r)], [r.name for r in rows if _by_adam(r)]


def _by_adam(row: Configuration) -> bool:
    return load_config(row.preset, row.changes).solver == "adam"


def configurations(named: list[tuple[str, dict[str, Any]]], base: dict[str, Any], where: str) -> list[Configuration]:
    """Return checked configurations.

    Args:
        named: Name and what it changes of ``base``.
        base: What all have in common.
        where: File or option, for messages.

    Raises:
        ConfigError: As :func:`read_grid`.
    """
    made = []
    for name, row in named:
        try:
            changes = (*_Way.model_validate(base).set, *_Way.model_validate(row).set)
            chosen = _Way.model_validate({**base, **row, "set": changes}).named(_folder_name(name))
            load_config(chosen.preset, chosen.changes)
        except (ConfigError, ValidationError) as error:
            raise ConfigError(f"{where}: {name[:60]}: {_said(error)}") from error
        made.append(chosen)
    try:
        check_names(made)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    return made


def _combination(values: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return name and changes of a point of a grid; what is no key of a row is a field of the configuration."""
    row: dict[str, Any] = {"set": []}
    for key, value in values.items():
        if key in _Way.model_fields:
            row[key] = value
        else:
            row["set"].append(f"{key}={_plain(value)}")
    return ", ".join(f"{key.rpartition('.')[2]} {_plain(value)}" for key, value in values.items()), row


def _plain(value: Any) -> str:
    """Return a value as YAML has it."""
    return str(value) if isinstance(value, str) else str(yaml.safe_dump(value, default_flow_style=True)).split("\n")[0]


def _folder_name(name: str) -> str:
    return name.replace("/", "-").strip()


def _said(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc'])) or 'the file'}: {first['msg']}"
    return " ".join(str(error).split())
