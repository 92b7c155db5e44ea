"""What a comparison says: ratios, and where Levenberg-Marquardt loses."""

from __future__ import annotations

import math
from dataclasses import dataclass

from uni4d_fg.pipeline.compare.benchmark import Benchmark, missed_tasks, spent_ratio, time_ratio
from uni4d_fg.pipeline.compare.comparison import Comparison
from uni4d_fg.pipeline.compare.solvers import LM
from uni4d_fg.pipeline.compare.trace import EQUAL

STAGE_OF_KIND = {
    "camera_init": "1",
    "bundle_adjustment": "2",
    "structure": "2",
    "further_landmarks": "2",
    "nonrigid": "3",
}
ALL_STAGES = "1-3"


@dataclass(frozen=True)
class StageRatio:
    """Levenberg-Marquardt against one opponent in one stage from one start."""

    stage: str
    start: str
    opponent: str
    spent: float
    """LM's time to the opponent's final energies over the opponent's own; a task in which it never got there counts
    with all of LM's time."""
    missed: int
    """Number of those tasks."""
    tasks: int
    back: float
    """The opponent's time to LM's final energies over LM's own; infinite where it never got there."""
    energy: float
    """LM's final exact energy over the opponent's, the largest of the stage's kinds of solves."""

    @property
    def time(self) -> float:
        """``spent``; infinite if there is a task in which LM never got there."""
        return math.inf if self.missed else self.spent


def stage_ratios(comparison: Comparison, opponent: str) -> list[StageRatio]:
    """Return one ratio per stage and start, and one over all stages per start.

    Stage 2 of the preset 'default' consists of two kinds of solves; their times are added.
    """
    out = []
    starts = list(dict.fromkeys(benchmark.start for benchmark in comparison.benchmarks))
    for stage in dict.fromkeys(STAGE_OF_KIND.values()):
        for start in starts:
            benchmarks = [c for c in comparison.benchmarks if STAGE_OF_KIND[c.kind] == stage and c.start == start]
            if benchmarks:
                out.append(_ratio(stage, start, benchmarks, opponent))
    common = [c for c in comparison.benchmarks if c.start == starts[0]] if starts and starts[0] == "common" else []
    for start in starts:
        benchmarks = [c for c in comparison.benchmarks if c.start == start and c not in common]
        if benchmarks and common:
            out.append(_ratio(ALL_STAGES, start, common + benchmarks, opponent))
    return out


def _ratio(stage: str, start: str, benchmarks: list[Benchmark], opponent: str) -> StageRatio:
    return StageRatio(
        stage,
        start,
        opponent,
        spent_ratio(benchmarks, LM, opponent),
        missed_tasks(benchmarks, LM, opponent),
        sum(benchmark.tasks for benchmark in benchmarks),
        time_ratio(benchmarks, opponent, LM),
        max(benchmark.energy_ratio(LM, opponent) for benchmark in benchmarks),
    )


def losses(comparison: Comparison) -> list[str]:
    """Return a sentence for everything in which Levenberg-Marquardt is behind another solver."""
    out = []
    for benchmark in comparison.benchmarks:
        mine = benchmark.performances[LM]
        for name in benchmark.performances:
            if name == LM:
                continue
            where = f"{benchmark.kind} from {benchmark.start}"
            ratio = benchmark.energy_ratio(LM, name)
            if ratio > 1.0 + EQUAL:
                out.append(f"{where}: LM ends {100 * (ratio - 1):.3g} % above {name}")
            elif mine.higher[name]:
                out.append(f"{where}: LM ends above {name} in {mine.higher[name]} of {benchmark.tasks} solves")
            time = benchmark.time_ratio(LM, name)
            if 1.0 < time < math.inf:
                out.append(f"{where}: LM needs {time:.2g} times as long as {name} to reach its energy")
    for name, energy in comparison.camera_init_energy.items():
        total = sum(comparison.camera_init_energy[LM].values())
        if total > sum(energy.values()) * (1.0 + EQUAL):
            out.append(f"stage 1 as a whole: LM ends {100 * (total / sum(energy.values()) - 1):.3g} % above {name}")
    for name, run in comparison.runs.items():
        for metric, value in comparison.runs[LM].accuracy.items():
            theirs = run.accuracy.get(metric)
            if theirs is not None and value > theirs * (1.0 + 1e-3):
                out.append(f"accuracy of the whole run: {metric} is {value:.4g} with LM, {theirs:.4g} with {name}")
        if comparison.runs[LM].optimization_seconds > run.optimization_seconds:
            out.append(f"whole run: stages 1 to 3 take LM longer than {name}")
    return out
