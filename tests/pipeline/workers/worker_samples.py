"""Functions that worker processes import: what can go wrong with a task."""

from __future__ import annotations

import os
import resource
import signal
import time
from pathlib import Path

import numpy as np

from uni4d_fg.errors import InputError
from uni4d_fg.factors.priors import log_scale_prior
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import LOG_SCALE
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.optim.stage_graph import RecordingRunner, StageGraph
from uni4d_fg.optim.threads import thread_count


def page_faults(count: int) -> int:
    """Return how many page faults it costs to make and drop so many arrays of 4 MB."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        np.ones(1 << 19)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def square_or_die(item: tuple[int, str, Path]) -> tuple[int, int, int]:
    """Return (number squared, process, threads); a 'killed' or 'hung' one does so at its first attempt only."""
    number, fate, folder = item
    mark = folder / f"{number}.tried"
    first = not mark.exists()
    with mark.open("a") as file:
        file.write("x")
    if first or fate.startswith("always"):
        if fate.endswith("killed"):
            os.kill(os.getpid(), signal.SIGKILL)
        if fate.endswith("hung"):
            while True:
                time.sleep(3600)
        if fate.endswith("raised"):
            raise RuntimeError(f"number {number} is broken")
    return number * number, os.getpid(), thread_count()


def describe_window(item: tuple[int, str, Path], run: StageRunner, hooks: Hooks) -> int:
    """Return the number of a window squared, and leave graphs of as many scales as its number tells."""
    number, fate, folder = item
    if fate == "hung" and not (folder / "hung").exists():
        (folder / "hung").touch()
        while True:
            time.sleep(3600)
    if fate == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if fate == "gone":
        raise InputError(f"{folder}: window {number} is gone")
    assert isinstance(run, RecordingRunner)
    for kind in ("structure", "nonrigid") if number < 2 else ("nonrigid",):
        scales = np.zeros((number + 1, 1))
        state = State({LOG_SCALE: scales})
        problem = Problem.over(state).add(log_scale_prior(np.arange(number + 1), measured=scales, sigma=0.1))
        run.solved[kind] = StageGraph(kind, problem, state, state)
    return number * number
