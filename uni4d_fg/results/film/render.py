"""Films and stills of a run as files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from uni4d_fg.errors import Cancelled, ConfigError
from uni4d_fg.files import atomic_path
from uni4d_fg.progress import Reporter, SilentReporter
from uni4d_fg.results.film.frames import Film, FilmClouds, schedule
from uni4d_fg.results.film.paths import FilmView
from uni4d_fg.results.film.video import open_gif, open_mp4
from uni4d_fg.results.run import Run

FILM_FORMATS = ("mp4", "gif", "png")


@dataclass(frozen=True)
class FilmOptions:
    """How films are made."""

    views: Sequence[FilmView] = (FilmView.orbit,)
    formats: Sequence[str] = ("mp4",)
    """Of :data:`FILM_FORMATS`; png gives stills."""
    height: int = 480
    """Of a picture, px."""
    frames_per_second: float = 15.0
    stills: int = 5
    """Number of stills of each view, evenly spread."""


def render_run(
    run: Run,
    folder: Path,
    options: FilmOptions | None = None,
    *,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> list[Path]:
    """Render a run into ``VIEW.mp4``, ``VIEW.gif`` and ``VIEW_00012.png``; each appears whole or not at all.

    Args:
        run: The run.
        folder: Where the files go.
        options: What is made.
        reporter: Told about progress.
        should_stop: Asked between pictures.

    Returns:
        The files.

    Raises:
        Cancelled: If ``should_stop`` said so.
        ConfigError: If an option makes no sense.
        InputError: If the run has nothing to show, or the video is needed and not there.
        OutputError: If a file cannot be written.
    """
    options = options or FilmOptions()
    if options.height < 16 or not 0.1 <= options.frames_per_second <= 120 or options.stills < 1:
        raise ConfigError("a film needs a height of 16 px or more, 0.1 to 120 frames per second and a still at least")
    unknown = sorted(set(options.formats) - set(FILM_FORMATS))
    if unknown:
        raise ConfigError(f"no such format of a film: {', '.join(unknown)}; there are {', '.join(FILM_FORMATS)}")
    reporter = reporter or SilentReporter()
    clouds = FilmClouds(run)
    films = [Film(clouds, view, options.height) for view in options.views]
    reporter.begin("static cloud", None)
    reporter.end(f"{len(clouds.static[0])} points")
    written: list[Path] = []
    for film in films:
        written += _films(film, folder, options, reporter, should_stop)
    return written


def _films(
    film: Film, folder: Path, options: FilmOptions, reporter: Reporter, should_stop: Callable[[], bool]
) -> list[Path]:
    name = film.view.value.replace("-", "_")
    plan = list(schedule(film.run.num_frames, options.frames_per_second))
    if film.view is FilmView.camera:
        plan = plan[: film.run.num_frames]
    stills = set(np.linspace(0, len(plan) - 1, min(options.stills, len(plan))).round().astype(int).tolist())
    if "png" not in options.formats:
        stills = set()
    moving = [kind for kind in ("mp4", "gif") if kind in options.formats]
    numbers = range(len(plan)) if moving else sorted(stills)
    written = [folder / f"{name}.{kind}" for kind in moving]
    reporter.begin(film.view.value, len(numbers))
    with ExitStack() as stack:
        size = film.size if film.view is not FilmView.side_by_side else (film.size[0], 2 * film.size[1])
        outputs = []
        if "mp4" in moving:
            outputs.append(stack.enter_context(open_mp4(folder / f"{name}.mp4", size, options.frames_per_second)))
        if "gif" in moving:
            outputs.append(stack.enter_context(open_gif(folder / f"{name}.gif", options.frames_per_second)))
        for done, number in enumerate(numbers):
            if should_stop():
                raise Cancelled("stopped; no film was written")
            picture = film.picture(*plan[number])
            for output in outputs:
                output.add(picture)
            if number in stills:
                written.append(_write_png(folder / f"{name}_{number:05d}.png", picture))
            reporter.advance(done + 1)
    reporter.end(", ".join(path.name for path in written[:2]))
    return written


def _write_png(path: Path, picture: np.ndarray) -> Path:
    _, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
    return path
