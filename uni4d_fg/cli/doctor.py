"""The verb ``doctor``: what is installed, what is missing, and what to do about it."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import print_json
from uni4d_fg.cli.expected_time import expected_time, expected_time_lines
from uni4d_fg.errors import ConfigError, MissingDependencyError

_PACKAGES = ("numpy", "scipy", "gtsam", "opencv-python-headless", "open3d", "matplotlib", "pydantic", "typer")

_EXTRAS = {
    "cues": ("onnxruntime", "depth, masks and tracks by networks"),
    "view": ("viser", "the interactive view"),
    "render": ("imageio_ffmpeg", "films in H.264"),
    "export": ("rerun", "rerun files (.rrd)"),
    "adam": ("torch", "comparison with Adam"),
    "models": ("pooch", "fetching published networks"),
    "cluster": ("distributed", "benchmarks on several processes and machines"),
}
"""Extra to a module of it, and what it is for."""


def doctor(
    cards: Annotated[bool, typer.Option("--cards", help="Show how to get the ONNX file of every model card.")] = False,
    time: Annotated[
        Path | None,
        typer.Option(
            "--time", metavar="SEQ|VIDEO", help="Say where the time of reconstructing this video will go instead."
        ),
    ] = None,
    config: options.ConfigChoice = None,
    json: options.Json = False,
) -> None:
    """Say what is installed, how fast it will be, which networks can be used, and what is missing."""
    if time is not None:
        expected = expected_time(time, config)
        if json:
            print_json(expected)
        else:
            typer.echo("\n".join(expected_time_lines(expected)))
        return
    found = examine()
    if json:
        print_json(found)
    else:
        typer.echo("\n".join(report_lines(found, cards)))


def examine() -> dict[str, Any]:
    """Return everything that ``doctor`` says, as plain data."""
    from uni4d_fg.optim.backend import choose_backend
    from uni4d_fg.optim.extension import find_extension
    from uni4d_fg.optim.threads import thread_count

    core, reason = find_extension()
    backend = choose_backend("auto")
    return {
        "uni4d-fg": _version("uni4d-fg"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "threads": {
            "usable_cores": thread_count(),
            "cores": os.cpu_count(),
            **{name: os.environ[name] for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS") if name in os.environ},
        },
        "extension": {
            "installed": core is not None, "version": _version("uni4d-fg-cpp"), "problem": reason,
            "backend": backend.name, "hint": backend.hint,
        },
        "open3d": _open3d(),
        "extras": {
            name: {
                "installed": find_spec(module) is not None,
                "for": purpose,
                "install": f"pip install 'uni4d-fg[{name}]'",
            }
            for name, (module, purpose) in _EXTRAS.items()
        },
        "onnxruntime": _onnxruntime(),
        "cards": _cards(),
    }  # fmt: skip


def report_lines(found: dict[str, Any], with_export: bool = False) -> list[str]:
    """Return what :func:`examine` found in words."""
    threads, extension, runtime = found["threads"], found["extension"], found["onnxruntime"]
    limits = "".join(f", {name}={value}" for name, value in threads.items() if name.isupper())
    lines = [
        f"uni4d-fg {found['uni4d-fg']}, Python {found['python']}, {found['platform']}",
        "packages: " + ", ".join(f"{name} {number}" for name, number in found["packages"].items()),
        f"threads: {threads['usable_cores']} of {threads['cores']} cores{limits}",
        f"C++ extension: {'uni4d-fg-cpp ' + extension['version'] if extension['installed'] else 'not in use'}; "
        f"solver backend {extension['backend']}",
    ]
    if extension["hint"]:
        lines.append(f"    {extension['hint']}")
    if found["open3d"]:
        lines.append(f"open3d: {found['open3d']}")
    lines.append("extras")
    for name, extra in found["extras"].items():
        state = "installed" if extra["installed"] else f"not installed: {extra['install']}"
        lines.append(f"    {name:<7} {state} ({extra['for']})")
    if runtime["version"] is None:
        lines.append(f"ONNX Runtime: {runtime['problem']}")
    else:
        lines.append(f"ONNX Runtime {runtime['version']}: {', '.join(runtime['providers'])}")
    lines.append("model cards")
    for name, card in found["cards"].items():
        if "problem" in card:
            lines.append(f"    {name}: {card['problem']}")
            continue
        state = f"ready, {card['path']}" if card["exists"] else f"{card['file']} is not there"
        lines.append(f"    {name:<24} {card['kind']:<12} {state}")
        if with_export:
            lines += [f"        {card['title']}; {card['license']}; {card['source']}", "        looked at:"]
            lines += [f"            {place}" for place in card["looked_at"]]
            lines += [f"        {line}" for line in card["export"].rstrip().splitlines()]
    if not with_export and not all(card.get("exists", True) for card in found["cards"].values()):
        lines.append("    how to get the files: uni4d-fg doctor --cards")
    return lines


def _onnxruntime() -> dict[str, Any]:
    from uni4d_fg.cues.session import available_providers

    try:
        return {"version": _version("onnxruntime"), "providers": available_providers(), "problem": ""}
    except MissingDependencyError as error:
        return {"version": None, "providers": [], "problem": str(error)}


def _cards() -> dict[str, Any]:
    from uni4d_fg.cues.card import card_names, cards_folder, find_model, load_card

    out: dict[str, Any] = {}
    for name in card_names():
        try:
            card = load_card(cards_folder() / f"{name}.yaml")
            model = find_model(name, card.kind)
        except ConfigError as error:
            out[name] = {"problem": str(error)}
            continue
        out[name] = {
            "kind": card.kind,
            "title": card.title,
            "license": card.license,
            "source": card.source,
            "file": card.file,
            "path": str(model.weights),
            "exists": model.weights.is_file(),
            "looked_at": [str(place) for place in model.searched()],
            "export": card.export,
        }
    return out


def _open3d() -> str:
    """Return why Open3D cannot be loaded; empty where it can. It is tried in full only if it is not loaded yet."""
    from uni4d_fg.optional import import_open3d

    if "open3d" in sys.modules:
        return ""
    try:
        import_open3d()
    except MissingDependencyError as error:
        return str(error)
    return ""


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
