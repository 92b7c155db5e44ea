"""One run of an experiment: a video, a configuration and where its result goes. Plain data, so that any process can."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from pydantic import TypeAdapter, ValidationError

from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.files import atomic_write_json
from uni4d_fg.reading import read_json

Masks: TypeAlias = Literal["cue", "true", "motion", "none"]
"""Of the cues, of the truth, from motion, or none at all: everything is static."""

_LONGEST_NAME = 200
"""Bytes."""
RESULT_VERSION = 3
"""Part of every key; raised whenever scores come out otherwise."""


@dataclass(frozen=True)
class Configuration:
    """A way to run this program: a row of the tables."""

    name: str
    preset: str = "default"
    changes: tuple[str, ...] = ()
    """``FIELD=VALUE``."""
    intrinsics: Literal["unknown", "known"] = "unknown"
    """Known: the true ones are given and held, as in the paper's Uni4D*."""
    depth: Literal["cue", "motion"] = "cue"
    """From the cues (made from motion where there are none), or always from camera motion."""
    masks: Masks = "cue"
    tracks: Literal["cue", "built_in"] = "cue"
    poses: Literal["estimate", "identity"] = "estimate"
    """Identity: bundle adjustment starts from cameras that do not move, as in the paper's 'stage 2 only'."""


@dataclass(frozen=True)
class Task:
    """One video with one configuration."""

    dataset: str
    root: str
    video: str
    configuration: Configuration
    out: str
    """Folder of the experiment."""
    cues: str | None = None
    """Folder with a folder of cues per video."""
    max_size: int | None = None
    """Longer side of the images, px; scores are at the truth's size."""
    pose_protocols: tuple[str, ...] = ("sim3",)
    depth_protocols: tuple[str, ...] = ()

    @property
    def run_folder(self) -> Path:
        """Where the run goes."""
        return Path(self.out) / "runs" / self.configuration.name / self.video

    @property
    def result_file(self) -> Path:
        """Where its result goes."""
        return Path(self.out) / "results" / self.configuration.name / f"{self.video}.json"

    @property
    def key(self) -> str:
        """Hash of all that the result depends on, but for the content of files."""
        told = {name: value for name, value in asdict(self).items() if name != "out"}
        text = json.dumps([RESULT_VERSION, told], sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@dataclass(frozen=True)
class TaskResult:
    """What came of a task; written as JSON."""

    key: str
    video: str
    method: str
    failed: str | None = None
    """Why it failed; None if it did not."""
    frames: int = 0
    scores: dict[str, Any] = field(default_factory=dict)
    """What :mod:`uni4d_fg.pipeline.benchmark.score` found."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time per stage; 'cues' for making what the video did not bring."""
    peak_memory_mb: float | None = None
    notes: tuple[str, ...] = ()

    def save(self, path: Path) -> None:
        """Write it. Raises OutputError."""
        atomic_write_json(path, asdict(self))


def stored_result(task: Task) -> TaskResult | None:
    """Return the finished result of a task that is on disk; None if there is none, it failed, or it is of another."""
    if not task.result_file.is_file():
        return None
    try:
        found = TypeAdapter(TaskResult).validate_python(read_json(task.result_file))
    except (InputError, ValidationError):
        return None
    return found if found.key == task.key and found.failed is None else None


def check_names(configurations: list[Configuration]) -> None:
    """Raise ConfigError if two configurations have one name, or one that is no name of a folder."""
    for name, count in Counter(c.name for c in configurations).items():
        if count > 1:
            raise ConfigError(f"two configurations are named {name!r}; give each a name of its own")
        is_plain = name.isprintable() and len(name.encode("utf-8", "replace")) <= _LONGEST_NAME
        if not name or not is_plain or name != Path(name).name or name.startswith("."):
            raise ConfigError(
                f"{name[:60]!r} cannot be the name of a folder; choose another name for the configuration"
            )
