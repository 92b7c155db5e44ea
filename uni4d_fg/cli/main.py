"""Entry point of ``uni4d-fg``: the verbs, and one place that turns errors into exit codes."""

from __future__ import annotations

import os
import sys
import traceback
from enum import Enum
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from uni4d_fg.cli.console import log_to_stderr, one_line, print_error
from uni4d_fg.cli.failures import finish, known_error
from uni4d_fg.errors import Cancelled

UNEXPECTED_EXIT_CODE = 70

_MODULES = {
    "demo": "reconstruction", "doctor": "doctor", "validate": "sequences", "track": "sequences", "cues": "cues",
    "reconstruct": "reconstruction", "stream": "streaming", "evaluate": "results", "export": "exports",
    "graph": "graphs", "view": "viewing", "share": "viewing", "render": "films", "report": "viewing",
    "compare": "comparison", "benchmark": "benchmark", "ablate": "benchmark", "synthesize": "sequences",
    "config": "results",
}  # fmt: skip
"""The module of every verb, which is a function of its name there, in the order of the help."""


def _show_version(wanted: bool) -> None:
    if wanted:
        try:
            typer.echo(f"uni4d-fg {version('uni4d-fg')}")
        except PackageNotFoundError:
            typer.echo("uni4d-fg (not installed)")
        raise typer.Exit


def _options(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show all log messages.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Take the options of every verb; ``--debug`` is dealt with in :func:`run`."""
    log_to_stderr(verbose)


def application(asked: str | None = None) -> typer.Typer:
    """Return the command line.

    Args:
        asked: The verb that will be called; the modules of others are then not loaded, which takes longer than some
            verbs do. All are there if it is None or no verb.
    """
    app = typer.Typer(
        name="uni4d-fg",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        callback=_options,
        help="Turn a video of a moving world into camera poses, static geometry and 3D motion.",
        epilog="Start with: uni4d-fg demo",
    )
    for verb in [asked] if asked in _MODULES else _MODULES:
        app.command()(getattr(import_module(f"uni4d_fg.cli.{_MODULES[verb]}"), verb))
    if asked not in _MODULES:
        app.add_typer(import_module("uni4d_fg.cli.models").app, name="models")
    return app


_TYPE_NAMES = {Path: "PATH", str: "TEXT", int: "NUMBER", float: "NUMBER"}
_SHORT = 16
"""Characters of a list of choices that fit into the column of types."""


def _tidy_help(command: Any) -> None:
    """Tidy the help of a command and of those below it: short names of types, none of flags, no breaks of lines."""
    if command.help:
        command.help = "\n\n".join(" ".join(part.split()) for part in command.help.split("\n\n"))
    for parameter in command.params:
        _tidy_parameter(parameter)
    get_help_option = command.get_help_option

    def tidy_help_option(context: Any) -> Any:
        option = get_help_option(context)
        if option is not None:
            option.metavar = ""
        return option

    command.get_help_option = tidy_help_option
    for below in getattr(command, "commands", {}).values():
        _tidy_help(below)


def _tidy_parameter(parameter: Any) -> None:
    """Give an option a short name of its type; choices that are long go into its help."""
    if getattr(parameter, "is_flag", False):
        parameter.metavar = ""
    # Of typer's own classes; without it, as in other versions, typer's names stay.
    kind = getattr(getattr(parameter, "type_descriptor", None), "annotation", None)
    if parameter.metavar is not None or not parameter.opts[0].startswith("-"):
        return
    kind = next((one for one in get_args(kind) if one is not type(None)), kind)
    if not (isinstance(kind, type) and issubclass(kind, Enum)):
        parameter.metavar = _TYPE_NAMES.get(kind) if isinstance(kind, type) else None
        return
    names = [str(choice.value) for choice in kind]
    parameter.metavar = "|".join(names)
    if len(parameter.metavar) > _SHORT:
        parameter.metavar = "NAME"
        parameter.help = f"{(parameter.help or '').rstrip('.')}: {', '.join(names)}."


def _from_home(word: str) -> str:
    """Return a word with the home folder in the place of ``~``, which shells leave as it is in ``--out=~/run``."""
    option, sign, value = word.partition("=") if word.startswith("--") else ("", "", word)
    return option + sign + os.path.expanduser(value) if value == "~" or value.startswith("~/") else word


def run(arguments: list[str]) -> int:
    """Run one command line and return its exit code."""
    debug = "--debug" in arguments
    try:
        asked = next((word for word in arguments if not word.startswith("-")), None)
        command = typer.main.get_command(application(asked))
        _tidy_help(command)
        command(args=[_from_home(word) for word in arguments if word != "--debug"], prog_name="uni4d-fg")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1 if stop.code else 0
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        known = known_error(error)
        if known is not None:
            print_error(one_line(known), "stopped" if isinstance(known, Cancelled) else "error")
            return known.exit_code
        print_error(
            f"unexpected {type(error).__name__}: {one_line(error)}; please report this with the command line "
            "and the output of the same command with --debug"
        )
        return UNEXPECTED_EXIT_CODE
    return 0


def main() -> None:
    """Run the command line of this process."""
    sys.exit(finish(run(sys.argv[1:])))


if __name__ == "__main__":
    main()
