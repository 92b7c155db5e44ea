"""Scores against ground truth, where there is any."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.results.evaluate.consistency import ConsistencyMetrics
from uni4d_fg.results.evaluate.depth import DepthReport
from uni4d_fg.results.evaluate.points import PointMetrics
from uni4d_fg.results.evaluate.protocols.consistency import ConsistencyScore
from uni4d_fg.results.evaluate.rigid_objects import ObjectReport
from uni4d_fg.results.evaluate.run import EvaluationReport, evaluate_run
from uni4d_fg.results.evaluate.trajectory import TrajectoryMetrics
from uni4d_fg.results.report.markup import Markup, element, number, section, table
from uni4d_fg.results.run import Run

_TITLE = "Accuracy against ground truth"
_TOO_CERTAIN = 2.0


def evaluate(run: Run) -> EvaluationReport | str:
    """Return the scores of a run, or why there are none."""
    sequence = run.sequence
    if sequence is None:
        return "The sequence is not at hand."
    truth = sequence.ground_truth
    if all(part is None for part in (truth.world_T_cam, truth.depths, truth.track_points)):
        return "The sequence has no ground truth: nothing here says how far the result is from it."
    if not isinstance(sequence, Sequence):
        return "The sequence was opened without its cues."
    try:
        return evaluate_run(run.folder.root, sequence)
    except InputError as error:
        return f"It could not be computed: {error}"


def accuracy(report: EvaluationReport | str) -> Markup:
    """Return the section with the scores."""
    if isinstance(report, str):
        return section("accuracy", _TITLE, element("p", report))
    parts = [
        *_trajectory(report.trajectory),
        *_consistency(report.consistency),
        *_depth("Depth, fused", report.depth),
        *_depth("Depth, cue", report.depth_cue),
        *_self_consistency(report.self_consistency),
        *_points("Landmarks", report.landmarks),
        *_points("Moving points", report.dynamic_points),
        *_objects(report.rigid_objects),
    ]
    absent = [f"{name.replace('_', ' ')}: {reason}" for name, reason in report.missing.items()]
    if absent:
        parts.append(element("p", "Not scored: " + "; ".join(absent) + ".", class_="muted"))
    return section("accuracy", _TITLE, *parts)


def _trajectory(metrics: TrajectoryMetrics | None) -> list[Markup]:
    if metrics is None:
        return []
    rows = [
        ["ATE", number(metrics.ate_m), "m"],
        ["RPE translation", number(metrics.rpe_translation_m), "m"],
        ["RPE rotation", number(metrics.rpe_rotation_deg), "deg"],
        ["scale (truth / estimate)", number(metrics.scale), ""],
        ["path length, truth", number(metrics.path_length_reference_m), "m"],
        ["poses", str(metrics.poses), ""],
    ]
    return [element("h3", "Camera trajectory"), table(metrics.protocol, ("measure", "value", "unit"), rows)]


def _consistency(results: Iterable[ConsistencyMetrics] | None) -> list[Markup]:
    """Compare the errors with what the covariances promised."""
    rows = [
        [m.protocol, number(m.mean, 3), number(m.median, 3), f"{100 * m.within_95:.0f} %", str(m.frames)]
        for m in results or ()
    ]
    if not rows:
        return []
    head = ("gauge", "mean, 1 if covariances hold", "median, likewise", "frames within their 95 % region", "frames")
    ratio = float(np.sqrt([m.median for m in results or ()][-1]))
    verdict = (
        f"Errors are typically {ratio:.2g} times as large as the covariances say"
        + (": do not take the covariances at their word." if ratio > _TOO_CERTAIN else ".")
    )  # fmt: skip
    return [element("h3", "Errors against covariances"), element("p", verdict), table("Consistency", head, rows)]


def _depth(title: str, report: DepthReport | None) -> list[Markup]:
    if report is None:
        return []
    out: list[Markup] = [element("h3", title)]
    for metrics in report.metrics.values():
        rows = [
            [
                name,
                number(region.abs_rel),
                "–" if region.delta_125 is None else f"{100 * region.delta_125:.2f} %",
                str(region.valid_pixels),
            ]
            for name, region in metrics.regions.items()
        ]
        out.append(table(metrics.protocol, ("region", "AbsRel", "δ < 1.25", "pixels"), rows))
    flicker = report.flicker
    text = (
        f"Scale flicker: standard deviation {number(flicker.standard_deviation)}, "
        f"frame to frame {number(flicker.frame_to_frame)}."
    )
    return [*out, element("p", text)]


def _self_consistency(scores: dict[str, ConsistencyScore] | None) -> list[Markup]:
    if not scores:
        return []
    rows = [
        [name, number(score.mean), f"{100 * score.below_1:.2f} %", f"{100 * score.below_5:.2f} %"]
        for name, score in scores.items()
    ]
    protocol = next(iter(scores.values())).protocol
    return [element("h3", "Depth against itself"), table(protocol, ("depth", "SC", "δ < 0.01", "δ < 0.05"), rows)]


def _points(title: str, results: Iterable[PointMetrics] | None) -> list[Markup]:
    rows = [[m.protocol, number(m.rmse_m), number(m.median_m), str(m.points)] for m in results or ()]
    if not rows:
        return []
    return [element("h3", title), table(title, ("protocol", "RMSE, m", "median, m", "points"), rows)]


def _objects(report: ObjectReport | None) -> list[Markup]:
    if report is None or not report.objects:
        return []
    rows = [
        [f"instance {one.instance}", number(one.rotation_max_deg), number(one.distance_max), str(one.frames)]
        for one in report.objects
    ]
    head = ("object", "largest rotation error, deg", "largest displacement, parts of the distance", "frames")
    return [element("h3", "Rigid objects"), table(report.protocol, head, rows)]
