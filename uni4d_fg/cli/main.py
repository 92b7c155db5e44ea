"""Entry point of ``uni4d-fg``: the verbs, and one place that turns errors into exit codes."""

from __future__ import annotations

import sys
import traceback
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any

import typer

from uni4d_fg.cli import (
    benchmark,
    comparison,
    cues,
    doctor,
    exports,
    films,
    graphs,
    models,
    reconstruction,
    results,
    sequences,
    streaming,
    viewing,
)
from uni4d_fg.cli.console import log_to_stderr, one_line, print_error
from uni4d_fg.cli.failures import finish, known_error
from uni4d_fg.errors import Cancelled

UNEXPECTED_EXIT_CODE = 70

app = typer.Typer(
    name="uni4d-fg",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Turn a video of a moving world into camera poses, static geometry and 3D motion.",
    epilog="Start with: uni4d-fg demo",
)
for verb in (
    reconstruction.demo, doctor.doctor, sequences.validate, sequences.track, cues.cues, reconstruction.reconstruct,
    streaming.stream,
    results.evaluate, exports.export, graphs.graph, viewing.view, viewing.share, films.render, viewing.report,
    comparison.compare, benchmark.benchmark, benchmark.ablate, sequences.synthesize, results.config,
):  # fmt: skip
    app.command()(verb)
app.add_typer(models.app, name="models")


def _show_version(wanted: bool) -> None:
    if wanted:
        try:
            typer.echo(f"uni4d-fg {version('uni4d-fg')}")
        except PackageNotFoundError:
            typer.echo("uni4d-fg (not installed)")
        raise typer.Exit


@app.callback()
def options(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show all log messages.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Take the options of every verb; ``--debug`` is dealt with in :func:`run`."""
    log_to_stderr(verbose)


def _tidy_help(command: Any) -> None:
    """Tidy the help of a command and of those below it: flags have no type, paragraphs no line breaks."""
    if command.help:
        command.help = "\n\n".join(" ".join(part.split()) for part in command.help.split("\n\n"))
    for parameter in command.params:
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
    for below in getattr(command, "commands", {}).values():
        _tidy_help(below)


def run(arguments: list[str]) -> int:
    """Run one command line and return its exit code."""
    debug = "--debug" in arguments
    try:
        command = typer.main.get_command(app)
        _tidy_help(command)
        command(args=[word for word in arguments if word != "--debug"], prog_name="uni4d-fg")
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
