"""Progress on standard error: bars on a terminal, one line per finished task elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from uni4d_fg.cli.console import STDERR, duration
from uni4d_fg.cli.forecast import Forecast, ForecastReporter
from uni4d_fg.progress import Reporter, SilentReporter


class RichReporter:
    """Draws the current task as a bar that stays on screen when the task ends."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self._task: TaskID | None = None

    def begin(self, task: str, total: int | None) -> None:
        """Start a bar; a task that was not ended is ended first."""
        if self._task is not None:
            self.end()
        self._task = self.progress.add_task(task, total=total, text="")

    def advance(self, done: int, text: str = "") -> None:
        """Move the bar to ``done``."""
        if self._task is not None:
            self.progress.update(self._task, completed=done, text=text)

    def end(self, text: str = "") -> None:
        """Fill the bar and stop its clock."""
        if self._task is None:
            return
        task = next(t for t in self.progress.tasks if t.id == self._task)
        total = task.total if task.total is not None else max(task.completed, 1)
        self.progress.update(self._task, total=total, completed=total, text=text)
        self.progress.stop_task(self._task)
        self._task = None


class LineReporter:
    """Prints one line when a task ends; for log files and pipes.

    Args:
        left: Says how long the whole run will still take; may be empty.
    """

    def __init__(self, left: Callable[[], str] = lambda: "") -> None:
        self._left = left
        self._task: str | None = None
        self._began = 0.0

    def begin(self, task: str, total: int | None) -> None:
        """Start the clock; a task that was not ended is ended first."""
        if self._task is not None:
            self.end()
        self._task, self._began = task, time.perf_counter()

    def advance(self, done: int, text: str = "") -> None:
        """Say nothing."""

    def end(self, text: str = "") -> None:
        """Print the task with the time it took."""
        if self._task is not None:
            more = "".join(f", {said}" for said in (text, self._left()) if said)
            typer.echo(f"{self._task}: {time.perf_counter() - self._began:.1f} s{more}", err=True)
        self._task = None


@contextmanager
def progress_reporter(quiet: bool, forecast: Forecast | None = None) -> Iterator[Reporter]:
    """Give the reporter that fits the terminal; the bars are closed at the end.

    Args:
        quiet: Say nothing.
        forecast: Of the whole run, which may have other parts before and behind; shown as a bar of its own, or with
            the line of every task.
    """
    if quiet:
        yield SilentReporter()
    elif not sys.stderr.isatty():
        yield LineReporter() if forecast is None else ForecastReporter(LineReporter(lambda: left(forecast)), forecast)
    else:
        columns = (
            SpinnerColumn(finished_text=" "),
            TextColumn("{task.description:<20}", markup=False),
            BarColumn(bar_width=24),
            TimeElapsedColumn(),
            TextColumn("{task.fields[text]}", markup=False, style="dim"),
        )
        with Progress(*columns, console=STDERR) as progress:
            if forecast is None:
                yield RichReporter(progress)
                return
            whole = progress.add_task("whole run", total=1.0, text="")

            def show() -> None:
                progress.update(whole, completed=forecast.state()[0], text=left(forecast))

            show()
            yield ForecastReporter(RichReporter(progress), forecast, show)


def left(forecast: Forecast) -> str:
    """Return the time that is left in words; empty while nobody can know."""
    _, seconds = forecast.state()
    return "" if seconds is None else f"about {duration(seconds)} left"
