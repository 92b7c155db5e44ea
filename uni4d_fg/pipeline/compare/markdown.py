"""A comparison as Markdown tables."""

from __future__ import annotations

import math
from collections.abc import Iterable

from uni4d_fg.pipeline.compare.benchmark import Benchmark, Performance
from uni4d_fg.pipeline.compare.comparison import Comparison
from uni4d_fg.pipeline.compare.ratios import StageRatio, losses, stage_ratios
from uni4d_fg.pipeline.compare.solvers import ADAM, LM
from uni4d_fg.pipeline.compare.whole_run import STAGES

_LEGEND = (
    "Times are wall times in seconds, medians over the repetitions, warm-up left out. 'time ratio' is LM's time to the "
    "other's final exact energy over the other's own time to it; 'never' means that it is not reached (one of several "
    "solves then counts with all of LM's time), 'not lowered' that the other ends no lower than it started. Every "
    "solve is repeated by every solver from the same state with the same variables free."
)


def markdown(comparisons: list[Comparison], machine: dict[str, str], command: str) -> str:
    """Return the whole report: one section per sequence and preset."""
    parts = ["# Levenberg-Marquardt and Adam, side by side", "", f"    {command}", ""]
    parts += [", ".join(f"{name} {value}" for name, value in machine.items()), ""]
    parts += [_LEGEND, ""]
    for comparison in comparisons:
        parts += section(comparison)
    crossed = accuracy_table(comparisons)
    if crossed:
        parts += ["## Accuracy: LM with `default` and Adam with `paper`", "", *crossed, ""]
    return "\n".join(parts)


def section(comparison: Comparison) -> list[str]:
    """Return the lines of one sequence and preset."""
    counts = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in comparison.tracks.items())
    lines = [
        f"## {comparison.sequence}, `{comparison.preset}`",
        "",
        f"{comparison.frames} frames; tracks: {counts}.",
        "",
    ]
    lines += ["Whole runs, each solver on its own:", "", *whole_runs_table(comparison), ""]
    lines += ["The same solves from the same starts:", "", *ratio_table(comparison), ""]
    lines += ["Final exact energies and times of these solves:", "", *energy_table(comparison), ""]
    found = losses(comparison)
    lines += ["Where LM is behind:" if found else "LM is behind nowhere.", ""]
    return [*lines, *(f"- {text}" for text in found), ""] if found else lines


def whole_runs_table(comparison: Comparison) -> list[str]:
    """Return time, memory and accuracy per solver."""
    metrics = list(dict.fromkeys(metric for run in comparison.runs.values() for metric in run.accuracy))
    head = ["solver", *(f"{stage} s" for stage in STAGES), "stages 1-3 s", "memory MB", *metrics]
    rows = []
    for name, run in comparison.runs.items():
        seconds = [f"{run.seconds[stage]:.2f}" for stage in STAGES]
        memory = "-" if run.extra_memory_mb is None else f"{run.extra_memory_mb:.0f}"
        scores = [f"{run.accuracy[m]:.4g}" if m in run.accuracy else "-" for m in metrics]
        rows.append([name, *seconds, f"{run.optimization_seconds:.2f}", memory, *scores])
    return table(head, rows)


def ratio_table(comparison: Comparison) -> list[str]:
    """Return LM against every other solver per stage and start."""
    head = ["stage", "start", "against", "time ratio", "energy LM / other", "other's time to LM's energy / LM's"]
    rows = [
        [r.stage, r.start, r.opponent, time_cell(r), f"{r.energy:.5f}", ratio(r.back)]
        for name in comparison.runs
        if name != LM
        for r in stage_ratios(comparison, name)
    ]
    return table(head, rows)


def energy_table(comparison: Comparison) -> list[str]:
    """Return energies per term, iterations and times per benchmark and solver."""
    head = ["solve", "start", "solver", "energy", "terms", "iterations", "s", "repetitions", "memory MB"]
    rows = [_energy_row(c, name, p) for c in comparison.benchmarks for name, p in c.performances.items()]
    for name, energy in comparison.camera_init_energy.items():
        cells = ["whole stage 1", "own windows", name, f"{sum(energy.values()):.6g}", terms(energy)]
        rows.append([*cells, "", "", "", ""])
    return table(head, rows)


def _energy_row(benchmark: Benchmark, name: str, performance: Performance) -> list[str]:
    what = f"{benchmark.kind} ({benchmark.tasks} solves)" if benchmark.tasks > 1 else benchmark.kind
    memory = "-" if performance.extra_memory_mb is None else f"{performance.extra_memory_mb:.0f}"
    return [
        what, benchmark.start, name, f"{performance.total_energy:.6g}", terms(performance.energy),
        str(performance.iterations), f"{performance.seconds:.3g}", str(performance.repetitions), memory,
    ]  # fmt: skip


def accuracy_table(comparisons: list[Comparison]) -> list[str]:
    """Return the scores of LM with 'default' beside those of Adam with 'paper', where both were run."""
    found = {(c.sequence, c.preset): c for c in comparisons}
    rows = []
    for name in dict.fromkeys(c.sequence for c in comparisons):
        ours, theirs = found.get((name, "default")), found.get((name, "paper"))
        if ours is None or theirs is None:
            continue
        reference = theirs.runs[ADAM].accuracy
        for metric, value in ours.runs[LM].accuracy.items():
            if metric in reference:
                rows.append(
                    [name, metric, f"{value:.4g}", f"{reference[metric]:.4g}", f"{value / reference[metric]:.3g}"]
                )
    head = ["sequence", "score", "LM, `default`", "Adam, `paper`", "LM / Adam"]
    return table(head, rows) if rows else []


def terms(energy: dict[str, float]) -> str:
    """Return energies per term in one cell."""
    return ", ".join(f"{name} {value:.5g}" for name, value in energy.items())


def time_cell(found: StageRatio) -> str:
    """Return LM's time ratio; where it misses some of many energies, the ratio of the times spent and how many."""
    if 0 < found.missed < found.tasks:
        return f"{ratio(found.spent)}, {found.missed} of {found.tasks} never"
    return ratio(found.time)


def ratio(value: float) -> str:
    """Return a ratio as ``1/40`` or ``2.5``; 'never' for infinity, 'not lowered' for NaN."""
    if math.isnan(value):
        return "not lowered"
    if math.isinf(value):
        return "never"
    return f"1/{1.0 / value:.3g}" if 0.0 < value < 1.0 else f"{value:.3g}"


def table(head: list[str], rows: Iterable[list[str]]) -> list[str]:
    """Return a Markdown table."""
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]
