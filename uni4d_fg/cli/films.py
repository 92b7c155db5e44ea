"""The verb ``render``."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.interruption import Interruption
from uni4d_fg.cli.progress import progress_reporter


class ViewChoice(str, Enum):
    """What a film shows."""

    orbit = "orbit"
    camera = "camera"
    side_by_side = "side-by-side"


class FilmFormat(str, Enum):
    """Kinds of files."""

    mp4 = "mp4"
    gif = "gif"
    png = "png"


def render(
    run: options.RunPath,
    view: Annotated[
        list[ViewChoice] | None,
        typer.Option(
            "--view", help="A swing around the scene, the camera's own view, or the video beside the swing; repeatable."
        ),
    ] = None,
    to: Annotated[
        list[FilmFormat] | None, typer.Option("--to", help="mp4, gif, or png for stills; repeatable.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the files; RUN/render if not given.")] = None,
    height: Annotated[int, typer.Option(help="Height of a picture, px.", min=16)] = 480,
    fps: Annotated[float, typer.Option(help="Frames per second.", min=0.1, max=120)] = 15.0,
    stills: Annotated[int, typer.Option(help="png: number of stills of each view.", min=1)] = 5,
    quiet: options.Quiet = False,
) -> None:
    """Render a run as film or stills, without a graphics card; an orbit as MP4 if not told otherwise."""
    from uni4d_fg.cli.viewing import open_run
    from uni4d_fg.results.film.paths import FilmView
    from uni4d_fg.results.film.render import FilmOptions, render_run
    from uni4d_fg.results.run_folder import RunFolder

    wanted = FilmOptions(
        views=[FilmView(choice.value) for choice in view or [ViewChoice.orbit]],
        formats=[choice.value for choice in to or [FilmFormat.mp4]],
        height=height,
        frames_per_second=fps,
        stills=stills,
    )
    opened = open_run(run)
    with progress_reporter(quiet) as reporter, Interruption() as stop:
        written = render_run(opened, out or RunFolder(run).films, wanted, reporter=reporter, should_stop=stop)
    for path in written:
        typer.echo(f"film: {path}" if path.suffix != ".png" else f"still: {path}")
