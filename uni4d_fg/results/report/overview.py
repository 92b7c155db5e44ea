"""What was run: sequence, configuration, versions, times and memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.config.load import load_config, preset_names, read_yaml
from uni4d_fg.errors import ConfigError
from uni4d_fg.results.report.markup import Markup, bullets, element, join, number, section, table
from uni4d_fg.results.run import Run
from uni4d_fg.slam.reconstruction import Reconstruction


def overview(run: Run) -> Markup:
    """Return the section about what was run."""
    summary = run.summary
    stages = summary.get("stages", {})
    return section(
        "run", "What was run", _facts(run), _cues(summary), _stages(stages), _config(run), _versions(summary)
    )


def _facts(run: Run) -> Markup:
    reconstruction, summary = run.reconstruction, run.summary
    height, width = reconstruction.image_size
    times = reconstruction.timestamps
    seconds = [_seconds(stage) for stage in summary.get("stages", {}).values()]
    memory = [stage.get("peak_memory_mb", 0.0) for stage in summary.get("stages", {}).values()]
    solver = summary.get("solver", {})
    cx, cy = reconstruction.intrinsics[2:].tolist()
    facts = {
        "Sequence": str(summary.get("sequence", {}).get("root") or run.name),
        "Frames": f"{run.num_frames}, {width} × {height} px",
        "Times": "not known"
        if np.array_equal(times, np.arange(len(times)))
        else f"{times[0]:.6g} to {times[-1]:.6g} s",
        "Time taken": _time_taken(sum(seconds), summary.get("cues")) if seconds else "not recorded",
        "Peak memory": f"{max(memory):.0f} MB" if any(memory) else "not recorded",
        "Solver": ", backend ".join(str(solver[key]) for key in ("solver", "backend") if key in solver)
        or "not recorded",
        "Focal length": _focal_length(reconstruction),
        "Principal point": f"cx {cx:.1f}, cy {cy:.1f} px",
        "Static landmarks": str(len(reconstruction.landmarks)),
        "Moving trajectories": str(len(reconstruction.dynamic_points)),
        "Unit of lengths": "meters of the depth cue" if run.is_metric else "unknown (not metric)",
    }
    return element(
        "dl", *(element("div", element("dt", name), element("dd", value)) for name, value in facts.items()),
        class_="facts",
    )  # fmt: skip


def _time_taken(stages: float, cues: Any) -> str:
    """Return the whole time: that of the cues is the larger part where a video brings none."""
    making = cues.get("seconds", 0.0) if isinstance(cues, dict) else 0.0
    if not making > 0:
        return f"{stages:.1f} s"
    return f"{stages + making:.1f} s, {making:.1f} s of it for cues"


def _focal_length(reconstruction: Reconstruction) -> str:
    fx, fy = reconstruction.frame_intrinsics[:, :2].T
    if reconstruction.zoom is None:
        return f"fx {fx[0]:.1f}, fy {fy[0]:.1f} px"
    return f"zoom: fx {fx.min():.1f} to {fx.max():.1f}, fy {fy.min():.1f} to {fy.max():.1f} px"


def _cues(summary: dict[str, Any]) -> Markup:
    cues = summary.get("cues")
    if not isinstance(cues, dict):
        return Markup("")
    lines = [f"{name.capitalize()}: {source}" for name, source in cues.get("sources", {}).items()]
    return join([element("h3", "Cues"), bullets([*lines, *map(str, cues.get("facts", []))])])


def _stages(stages: dict[str, Any]) -> Markup:
    if not stages:
        return element("p", "The run recorded nothing about its stages.", class_="muted")
    rows = []
    for name, stage in stages.items():
        title = name.replace("_", " ") + (" (taken over)" if stage.get("resumed") else "")
        rows.append([title, f"{_seconds(stage):.1f}", number(stage.get("peak_memory_mb"), 4)])
    facts = [f"{name.replace('_', ' ')}: {fact}" for name, stage in stages.items() for fact in _stage_facts(stage)]
    return join([
        element("h3", "Stages"),
        table("Time and memory of the stages", ("stage", "seconds", "peak memory so far, MB"), rows),
        bullets(facts),
    ])  # fmt: skip


def _seconds(stage: dict[str, Any]) -> float:
    """Return the time a stage took; ``stream`` records it per phase."""
    seconds = stage.get("seconds", 0.0)
    return float(seconds.get("total", 0.0) if isinstance(seconds, dict) else seconds)


def _stage_facts(stage: dict[str, Any]) -> list[str]:
    counts = [f"{count} frames {name}" for name, count in stage.get("counts", {}).items()]
    return [*map(str, stage.get("facts", [])), *([", ".join(counts)] if counts else [])]


def _config(run: Run) -> Markup:
    title = element("h3", "Configuration")
    found = nearest_preset(run.folder.config)
    if found is None:
        return join([title, element("p", f"{run.folder.config.name} cannot be read.", class_="muted")])
    preset, changes = found
    absent = [field for field, (_, here) in changes.items() if here is None]
    rows = [[field, _short(there), _short(here)] for field, (there, here) in changes.items() if here is not None]
    said = "unchanged." if not rows else "with one change:" if len(rows) == 1 else f"with {len(rows)} changes:"
    parts = [title, element("p", "Preset ", element("code", preset), f", {said}")]
    if rows:
        parts.append(table("Changed fields", ("field", f"preset {preset}", "this run"), rows))
    if absent:
        text = f"The run was made by a version without {len(absent)} fields of today's preset: {', '.join(absent)}."
        parts.append(element("details", element("summary", "Fields that are newer than the run"), element("p", text)))
    return join(parts)


def nearest_preset(config: Path) -> tuple[str, dict[str, tuple[Any, Any]]] | None:
    """Return the preset that a run's configuration differs from least, and field to (preset's, run's) value.

    The fields are compared as they are written, so that configurations of other versions can be read; a field that one
    of both lacks stands as None. None if the file cannot be read.
    """
    try:
        used = _leaves(read_yaml(config))
    except ConfigError:
        return None
    best: tuple[str, dict[str, tuple[Any, Any]]] | None = None
    for name in sorted(preset_names(), key=lambda preset: preset != "default"):
        try:
            preset = _leaves(load_config(name).model_dump(mode="json"))
        except ConfigError:
            continue
        fields = dict.fromkeys([*used, *preset])
        changes = {
            field: (preset.get(field), used.get(field)) for field in fields if preset.get(field) != used.get(field)
        }
        if best is None or len(changes) < len(best[1]):
            best = name, changes
    return best


def _leaves(values: Any, prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in values.items() if isinstance(values, dict) else ():
        path = f"{prefix}.{key}" if prefix else str(key)
        if isinstance(value, dict) and value:
            out |= _leaves(value, path)
        else:
            out[path] = value
    return out


def _short(value: Any) -> str:
    return "absent" if value is None else str(value)


def _versions(summary: dict[str, Any]) -> Markup:
    versions = summary.get("versions", {})
    rows = [[str(name), str(version)] for name, version in versions.items()]
    if not rows:
        return Markup("")
    return element("details", element("summary", "Versions"), table("Versions", ("package", "version"), rows))
