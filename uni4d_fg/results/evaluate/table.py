"""An evaluation report as plain text."""

from __future__ import annotations

from uni4d_fg.results.evaluate.consistency import ConsistencyMetrics
from uni4d_fg.results.evaluate.depth import DepthReport
from uni4d_fg.results.evaluate.points import PointMetrics
from uni4d_fg.results.evaluate.protocols.consistency import ConsistencyScore
from uni4d_fg.results.evaluate.rigid_objects import ObjectReport
from uni4d_fg.results.evaluate.run import EvaluationReport
from uni4d_fg.results.evaluate.trajectory import TrajectoryMetrics

_NAME_WIDTH = 34


def format_report(report: EvaluationReport) -> str:
    """Return the report as lines of text: each number under the protocol it was computed with."""
    lines = [f"{report.sequence}: {report.frames} frames, {report.run_dir}"]
    lines += _section("Camera trajectory", report, "trajectory", _trajectory_lines(report.trajectory))
    if report.trajectory is not None and report.poses_without_truth:
        lines.append(_row("frames without a true pose", str(report.poses_without_truth)))
    if report.consistency is not None or "consistency" in report.missing:
        lines += _section("Covariances of the cameras", report, "consistency", _consistency_lines(report.consistency))
    lines += _section("Depth, fused", report, "depth", _depth_lines(report.depth))
    lines += _section("Depth, cue", report, "depth_cue", _depth_lines(report.depth_cue))
    if report.self_consistency is not None:
        lines += ["", "Depth against itself", *_self_consistency_lines(report.self_consistency)]
    lines += _section("Landmarks", report, "landmarks", _point_lines(report.landmarks))
    lines += _section("Dynamic points", report, "dynamic_points", _point_lines(report.dynamic_points))
    if report.rigid_objects is not None or "rigid_objects" in report.missing:
        lines += _section("Rigid objects", report, "rigid_objects", _object_lines(report.rigid_objects))
    return "\n".join(lines) + "\n"


def _section(title: str, report: EvaluationReport, part: str, lines: list[str]) -> list[str]:
    if part in report.missing:
        return ["", f"{title}: {report.missing[part]}"]
    return ["", title, *lines]


def _row(name: str, value: str) -> str:
    return f"  {name:<{_NAME_WIDTH}}{value}"


def _number(value: float | None, unit: str, digits: int = 4) -> str:
    return "not defined" if value is None else f"{value:.{digits}f}{unit}"


def _trajectory_lines(metrics: TrajectoryMetrics | None) -> list[str]:
    if metrics is None:
        return []
    lines = [
        f"  [{metrics.protocol}]",
        _row("ATE", _number(metrics.ate_m, " m")),
        _row("RPE translation", _number(metrics.rpe_translation_m, " m")),
        _row("RPE rotation", _number(metrics.rpe_rotation_deg, " deg")),
        _row("scale (truth / estimate)", _number(metrics.scale, "")),
        _row("path length, estimate", _number(metrics.path_length_estimate_m, " m", 3)),
        _row("path length, truth", _number(metrics.path_length_reference_m, " m", 3)),
        _row("poses", str(metrics.poses)),
    ]
    if metrics.degenerate != "none":
        lines.append(_row("alignment is degenerate", metrics.degenerate.replace("_", " ")))
    return lines


def _consistency_lines(results: tuple[ConsistencyMetrics, ...] | None) -> list[str]:
    lines: list[str] = []
    for metrics in results or ():
        lines.append(f"  [{metrics.protocol}; 1 where covariances hold]")
        lines.append(_row("mean / by the median", f"{metrics.mean:.2f} / {metrics.median:.2f}"))
        lines.append(_row("rotations / positions alone", f"{metrics.rotation:.2f} / {metrics.position:.2f}"))
        shares = f"{100 * metrics.within_95:.0f} % / {100 * metrics.within_99:.0f} %"
        lines.append(_row("frames within 95 % / 99 % regions", shares))
    return lines


def _depth_lines(report: DepthReport | None) -> list[str]:
    if report is None:
        return []
    lines: list[str] = []
    for metrics in report.metrics.values():
        lines += [
            f"  [{metrics.protocol}]",
            f"  {'region':<16}{'AbsRel':>10}{'d<1.25':>10}{'pixels':>12}{'missing':>12}",
        ]
        for name, region in metrics.regions.items():
            abs_rel = "-" if region.abs_rel is None else f"{region.abs_rel:.4f}"
            delta = "-" if region.delta_125 is None else f"{100 * region.delta_125:.2f} %"
            lines.append(
                f"  {name:<16}{abs_rel:>10}{delta:>10}{region.valid_pixels:>12}{region.missing_predictions:>12}"
            )
        without = metrics.regions["all"].frames_without_valid_pixels if "all" in metrics.regions else 0
        if without:
            lines.append(_row("frames without a valid pixel", str(without)))
    flicker = report.flicker
    lines.append("  [scale flicker: log median(prediction / truth) of static pixels per frame]")
    lines.append(_row("standard deviation", _number(flicker.standard_deviation, "")))
    lines.append(_row("frame-to-frame", _number(flicker.frame_to_frame, "")))
    return lines


def _self_consistency_lines(scores: dict[str, ConsistencyScore]) -> list[str]:
    lines = [f"  [{next(iter(scores.values())).protocol}]", f"  {'':<16}{'SC':>10}{'< 0.01':>10}{'< 0.05':>10}"]
    for name, score in scores.items():
        shares = "".join(f"{100 * share:>8.2f} %" for share in (score.below_1, score.below_5))
        lines.append(f"  {name:<16}{score.mean:>10.4f}{shares}")
    return lines


def _point_lines(results: tuple[PointMetrics, ...] | None) -> list[str]:
    lines: list[str] = []
    for metrics in results or ():
        lines.append(f"  [{metrics.protocol}]")
        lines.append(_row("RMSE / median", f"{_number(metrics.rmse_m, ' m')} / {_number(metrics.median_m, ' m')}"))
        counts = (
            f"{metrics.points} ({metrics.missing_estimates} without estimate, {metrics.missing_truth} without truth)"
        )
        lines.append(_row("points", counts))
    return lines


def _object_lines(report: ObjectReport | None) -> list[str]:
    if report is None:
        return []
    lines = [f"  [{report.protocol}]"]
    for one in report.objects:
        turn = f"{_number(one.rotation_rms_deg, '')} / {_number(one.rotation_max_deg, ' deg')}"
        rms, largest = (None if v is None else 100 * v for v in (one.distance_rms, one.distance_max))
        lines.append(_row(f"instance {one.instance}, rotation RMS / max", turn))
        away = f"{_number(rms, '')} / {_number(largest, ' % of the distance to the camera')}"
        lines.append(_row("displacement RMS / max", away))
        lines.append(_row("frames", str(one.frames)))
    for text, names in (("rigid, without a true pose", report.without_truth), ("not found", report.not_found)):
        if names:
            lines.append(_row(text, ", ".join(f"instance {name}" for name in names)))
    return lines
