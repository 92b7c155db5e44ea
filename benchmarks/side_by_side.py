"""What benchmarks of several solvers share: runs in processes of their own, their memory, and pictures of times."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from uni4d_fg.errors import Uni4dFgError
from uni4d_fg.pipeline.compare.memory import PeakMemory
from uni4d_fg.results.pictures.figure import GRID, INK, MUTED, new_figure, save_figure

COLORS = ("#0b6e4f", "#c8553d", "#3d5a98", "#b58900", "#7b4fa3")
EQUAL = 1e-6
"""Two final energies this close, relatively, are equal."""


def with_memory(solve: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what ``solve`` returns, with 'peak_mb' (whole process, while solving) and 'added_mb' (above the start).

    The peak is that of this address space: ``ru_maxrss`` of a child also counts the parent's memory when it forked.
    """
    with PeakMemory() as memory:
        result = solve()
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak = next(float(line.split()[1]) / 1024.0 for line in status.splitlines() if line.startswith("VmHWM:"))
    added = float("nan") if memory.extra_mb is None else memory.extra_mb
    return {**result, "peak_mb": peak, "added_mb": added}


def run_apart(script: str, arguments: list[str], repeats: int, threads: int | None = None) -> dict[str, Any] | None:
    """Run a script in processes of its own and return the result of the smallest 'total'.

    Args:
        script: File that prints its result as one line of JSON.
        arguments: Its arguments.
        repeats: Number of processes, one after the other.
        threads: Threads of OpenMP; the environment's when None.

    Returns:
        The fastest result; None if the script failed, its last line on standard error.
    """
    environment = dict(os.environ) if threads is None else {**os.environ, "OMP_NUM_THREADS": str(threads)}
    results = []
    for _ in range(repeats):
        done = subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True, env=environment)
        if done.returncode != 0:
            reason = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
            print(f"{' '.join(arguments)}: {reason}", file=sys.stderr)
            return None
        results.append(json.loads(done.stdout.strip().splitlines()[-1]))
    return min(results, key=lambda result: float(result["total"]))


def run_main(main: Callable[[], None]) -> None:
    """Run a benchmark; what a user can repair is one line on standard error."""
    try:
        main()
    except Uni4dFgError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


@dataclass(frozen=True)
class Times:
    """One panel of a picture."""

    title: str
    size_label: str
    seconds: Mapping[str, Mapping[Any, float]]
    """Solver -> size -> s. Numbers as sizes are drawn as lines over logarithmic axes, names as bars."""


def draw_times(path: Path, panels: list[Times]) -> None:
    """Draw the time of every solver and size; PNG.

    Raises:
        OutputError: If the file cannot be written.
    """
    panels = [panel for panel in panels if any(panel.seconds.values())]
    if not panels:
        print(f"{path}: not written, nothing was measured", file=sys.stderr)
        return
    figure = new_figure(7.0 * len(panels), 4.2)
    for index, times in enumerate(panels):
        panel = figure.add_subplot(1, len(panels), index + 1)
        sizes = list(dict.fromkeys(size for by_size in times.seconds.values() for size in by_size))
        if len(sizes) > 1 and all(isinstance(size, int | float) for size in sizes):
            _draw_lines(panel, times)
        else:
            _draw_bars(panel, times, sizes)
        panel.set_yscale("log")
        panel.set_title(times.title, loc="left", fontsize=10, color=MUTED)
        panel.set_xlabel(times.size_label, color=INK, fontsize=9)
        panel.set_ylabel("time [s]", color=INK, fontsize=9)
        panel.tick_params(which="both", labelsize=8, colors=MUTED)
        panel.grid(True, axis="y", which="major", color=GRID, linewidth=0.8)
        panel.set_axisbelow(True)
        panel.legend(frameon=False, fontsize=8, labelcolor=INK, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        for spine in panel.spines.values():
            spine.set_visible(False)
    save_figure(path, figure)


def _draw_lines(panel: Axes, times: Times) -> None:
    for color, (solver, by_size) in zip(COLORS * 9, times.seconds.items(), strict=False):
        sizes = sorted(by_size)
        panel.plot(sizes, [by_size[size] for size in sizes], "o-", color=color, linewidth=1.8, label=solver)
    panel.set_xscale("log")
    measured = sorted({size for by_size in times.seconds.values() for size in by_size})
    panel.set_xticks(measured, [f"{size:,}" for size in measured])
    panel.minorticks_off()


def _draw_bars(panel: Axes, times: Times, sizes: list[Any]) -> None:
    width = 0.8 / len(times.seconds)
    for index, (solver, by_size) in enumerate(times.seconds.items()):
        place = np.array([sizes.index(size) for size in by_size]) + (index + 0.5) * width - 0.4
        bars = panel.bar(place, list(by_size.values()), 0.9 * width, color=(COLORS * 9)[index], label=solver)
        panel.bar_label(bars, fmt="%.2g", fontsize=7, color=MUTED)
    panel.set_xticks(range(len(sizes)), [str(size) for size in sizes])
    shortest = min(seconds for by_size in times.seconds.values() for seconds in by_size.values())
    panel.set_ylim(bottom=10.0 ** np.floor(np.log10(0.8 * shortest)))
