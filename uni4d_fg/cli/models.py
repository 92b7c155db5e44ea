"""The verbs ``models``, ``models fetch`` and ``models add``: networks that make cues."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import print_json, table_lines
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.errors import ConfigError

app = typer.Typer(
    help="List the networks that make cues; fetch or add their files. Nothing is downloaded unless asked for by name.",
    invoke_without_command=True,
)


@app.callback()
def models(context: typer.Context, json: options.Json = False) -> None:
    """List the known networks: what they make, their license, size, and whether their file is there."""
    if context.invoked_subcommand is not None:
        return
    from uni4d_fg.cues.card import models_folder
    from uni4d_fg.cues.model_store import entry, installed_cards

    found = {name: entry(name, path) for name, path in installed_cards().items()}
    if json:
        print_json({"folder": models_folder(), "models": found})
        return
    typer.echo("\n".join(table_lines(("name", "makes", "license", "size", "file"), _rows(found))))
    typer.echo(f"Folder of models: {models_folder()}")
    typer.echo("Fetch a published file: uni4d-fg models fetch NAME. Others are made: uni4d-fg doctor --cards says how.")


def _rows(found: dict[str, dict[str, Any]]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, model in found.items():
        size = "" if model["size_bytes"] is None else _megabytes(model["size_bytes"])
        state = "ready" if model["path"] else "can be fetched" if model["published"] else "to be made"
        rows.append((name, model["makes"], model["license"], size, state))
    return rows


@app.command()
def fetch(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the model.", show_default=False)],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    quiet: options.Quiet = False,
) -> None:
    """Download the published ONNX file of a model, after asking, and compare its checksum."""
    from uni4d_fg.cues import model_store

    present = model_store.installed_cards().get(name)
    if present is not None:
        typer.echo(f"{name}: already there: {present}")
        return
    file = model_store.published(name)
    model = model_store.entry(name, None)
    size = "of unknown size" if file.size_bytes is None else _megabytes(file.size_bytes)
    typer.echo(f"{model['title']}, {size}, license {model['license']}")
    typer.echo(f"    from {file.url}")
    typer.echo(f"    SHA-256 {file.sha256}")
    if not yes and not typer.confirm("Download it?"):
        raise ConfigError("nothing was downloaded; --yes answers beforehand")
    with progress_reporter(quiet) as reporter:
        path = model_store.fetch(name, file, reporter)
    typer.echo(f"{name}: {path}")


@app.command()
def add(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="ONNX file.", show_default=False)],
    card: Annotated[
        str | None, typer.Option("--card", metavar="NAME", help="The model that it is.", show_default=False)
    ] = None,
) -> None:
    """Copy an ONNX file that you have or made to where it is found by name."""
    from uni4d_fg.cues.model_store import add as add_file

    name, path = add_file(file, card)
    typer.echo(f"{name}: {path}")


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"
