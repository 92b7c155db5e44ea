"""Verbs for looking at a run: ``view``, ``report``, ``share``."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.results.run_folder import RunFolder, is_finished

if TYPE_CHECKING:
    from uni4d_fg.results.run import Run

_LOADING_ENDS_S = 5.0


def view(
    run: options.RunPath,
    host: Annotated[str, typer.Option(help="Address to listen at; 0.0.0.0 for other machines as well.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen at.", min=1, max=65535)] = 8080,
    max_points: Annotated[int, typer.Option(help="Points of the static cloud that are sent.", min=1)] = 3_000_000,
) -> None:
    """Show a run in a browser: cameras, clouds and trajectories over time; of a run that is going on, what it has."""
    from uni4d_fg.results.shot_list import refuse_split
    from uni4d_fg.results.view.server import viewer_server

    # Ctrl-C is how a viewer is closed, so that it is no failure; a shell's background job is started deaf to it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    refuse_split(run)
    is_finished(RunFolder(run), unfinished=True)
    with contextlib.suppress(KeyboardInterrupt), viewer_server(host, port, "uni4d-fg") as server:
        # A browser that waits loads the page while the rest of the program and the run are loaded.
        from uni4d_fg.results.view.content import Limits
        from uni4d_fg.results.view.viewer import Viewer

        opened = open_run(run, unfinished=True)
        viewer = Viewer(server, opened, Limits(static_points=max_points))
        shown = f"[{host}]" if ":" in host else host
        typer.echo(f"{opened.name}: http://{shown}:{port} (Ctrl-C ends)")
        sys.stdout.flush()
        ended = threading.Event()
        loading = threading.Thread(target=viewer.load_when_seen, args=(ended.is_set,), daemon=True)
        loading.start()
        try:
            viewer.run_until(lambda: False)
        finally:
            ended.set()
            loading.join(_LOADING_ENDS_S)


def report(
    run: options.RunPath,
    out: Annotated[
        Path | None, typer.Option(help="The page; RUN/report.html if not given.", show_default=False)
    ] = None,
) -> None:
    """Write one self-contained HTML page about a run: what was done, how well, and what to distrust."""
    from uni4d_fg.results.report.build import write_report
    from uni4d_fg.results.shot_list import finished_shots, is_split, refuse_split

    if out is not None:
        refuse_split(run)
    for folder in finished_shots(run) if is_split(run) else [run]:
        path = out or RunFolder(folder).report
        write_report(open_run(folder), path)
        typer.echo(f"report: {path}")


def share(
    run: options.RunPath,
    out: Annotated[Path | None, typer.Option(help="The page; RUN/share.html if not given.", show_default=False)] = None,
    max_mb: Annotated[float, typer.Option(help="Most megabytes; points are left out to keep it.", min=0)] = 25.0,
    fps: Annotated[
        float | None, typer.Option(help="Frames per second; those of the video if not given.", min=0.1, max=120)
    ] = None,
    quiet: options.Quiet = False,
) -> None:
    """Write one HTML page that plays the run in 3D in any browser, without a network."""
    from uni4d_fg.results.view.share import write_page

    with progress_reporter(quiet) as reporter:
        page = write_page(
            open_run(run), out or RunFolder(run).shared_page, max_mb, frames_per_second=fps, reporter=reporter
        )
    points = f"{page.static_points} static and {page.moving_points} moving points"
    if page.landmarks:
        points = f"{page.landmarks} landmarks in the place of a cloud, which the run does not have"
    typer.echo(f"page: {page.path}, {page.megabytes:.1f} MB, {page.frames} frames, {points}")


def open_run(run: Path, *, unfinished: bool = False) -> Run:
    """Open a run with the sequence that it was made from; with ``unfinished`` one that is going on as well."""
    from uni4d_fg.cli.runs import stored_input
    from uni4d_fg.results.run import Run
    from uni4d_fg.results.shot_list import refuse_split

    refuse_split(run)
    return Run(run, lambda: stored_input(run).read(), unfinished=unfinished)
