"""A solver's own run from tracks to fused depth, and how good its result is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline import reconstruct
from uni4d_fg.pipeline.compare.memory import PeakMemory
from uni4d_fg.progress import Reporter
from uni4d_fg.results.evaluate.run import EvaluationReport, evaluate_run

STAGES = ("camera_init", "bundle_adjustment", "nonrigid")


@dataclass(frozen=True)
class WholeRun:
    """Time and accuracy of one run."""

    seconds: dict[str, float]
    """Wall time per stage, fusion and output included."""
    extra_memory_mb: float | None
    """Peak resident memory above that before the run."""
    accuracy: dict[str, float]
    """Scores against the ground truth, those that it allows; lower is better."""

    @property
    def optimization_seconds(self) -> float:
        """Wall time of stages 1 to 3."""
        return sum(self.seconds[stage] for stage in STAGES)


def whole_run(
    sequence: Sequence,
    folder: Path,
    config: Config,
    *,
    reporter: Reporter | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> WholeRun:
    """Reconstruct from the start and score the result.

    Raises:
        Uni4dFgError: As :func:`uni4d_fg.pipeline.reconstruct`.
    """
    with PeakMemory() as peak:
        summary = reconstruct(sequence, folder, config, reporter=reporter, should_stop=should_stop)
    seconds = {name: float(stage["seconds"]) for name, stage in summary.stages.items()}
    return WholeRun(seconds, peak.extra_mb, accuracy(evaluate_run(folder, sequence)))


def accuracy(report: EvaluationReport) -> dict[str, float]:
    """Return the scores of a report by name and unit; one that is not defined is left out."""
    found: dict[str, float | None] = {}
    if report.trajectory is not None:
        found["ATE, m"] = report.trajectory.ate_m
        found["RPE translation, m"] = report.trajectory.rpe_translation_m
        found["RPE rotation, deg"] = report.trajectory.rpe_rotation_deg
    if report.dynamic_points is not None:
        observed = [p for p in report.dynamic_points if "Sim(3)" in p.protocol and "observed" in p.protocol]
        found["moving points RMSE, m"] = observed[0].rmse_m if observed else None
    if report.depth is not None:
        regions = report.depth.metrics["scale"].regions
        for name, label in (("all", "depth AbsRel"), ("static", "static AbsRel"), ("dynamic", "moving AbsRel")):
            found[label] = regions[name].abs_rel if name in regions else None
    return {name: float(value) for name, value in found.items() if value is not None}
