"""The camera path from above and from the side, and how certain it is."""

from __future__ import annotations

import matplotlib
import numpy as np

from uni4d_fg.arrays import FloatArray, evenly_spread
from uni4d_fg.geometry.alignment import align_trajectories
from uni4d_fg.results.measures import pose_sigmas
from uni4d_fg.results.pictures.figure import upright_axes
from uni4d_fg.results.report.chart import Line, line_chart, nice_ticks, svg
from uni4d_fg.results.report.markup import Markup, element, figure, section
from uni4d_fg.results.run import Run

_SIZE = 330
_LEFT, _BOTTOM, _MARGIN = 52, 42, 10
_MAX_SEGMENTS = 240
_MIN_EXTENT = 0.02


def trajectory(run: Run) -> Markup:
    """Return the section with the camera path in two views."""
    poses = run.reconstruction.world_T_cam
    truth = None if run.sequence is None else run.sequence.ground_truth.world_T_cam
    if truth is not None and truth.shape == poses.shape:
        known = np.asarray(np.isfinite(truth).all(axis=(1, 2)))
        if known.any():
            poses = align_trajectories(poses[known], truth[known]).apply_poses(poses)
        truth = truth[known] if known.any() else None
    else:
        truth = None
    axes, origin = upright_axes(poses), poses[0, :3, 3]
    path = (poses[:, :3, 3] - origin) @ axes.T
    true_path = None if truth is None else (truth[:, :3, 3] - origin) @ axes.T
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    unit = run.unit
    views = (("top", "Top view", 0, 1, "right", "forward"), ("side", "Side view", 1, 2, "forward", "up"))
    drawn = [
        figure(_plan(f"path-{key}", name, path[:, (i, j)], None if true_path is None else true_path[:, (i, j)],
                     f"{label_x} [{unit}]", f"{label_y} [{unit}]"), name)
        for key, name, i, j, label_x, label_y in views
    ]  # fmt: skip
    extent = np.ptp(path, axis=0)
    text = (
        f"The camera travels {steps.sum():.3g} {unit} within a box of {extent[0]:.3g} × {extent[1]:.3g} × "
        f"{extent[2]:.3g} {unit} (right, forward, up). The circle is the first frame; color goes from violet (first) "
        "to yellow (last)."
    )
    if true_path is not None:
        text += " The dashed line is the ground truth, to which the estimate is aligned with Sim(3)."
    return section("trajectory", "Trajectory", element("p", text), element("div", *drawn, class_="charts"))


def _plan(
    identifier: str, title: str, path: FloatArray, truth: FloatArray | None, label_x: str, label_y: str
) -> Markup:
    """Draw a path (T, 2) with equal axes, colored by frame."""
    everything = path if truth is None else np.concatenate((path, truth))
    low, high = everything.min(axis=0), everything.max(axis=0)
    half = 0.56 * max(float((high - low).max()), _MIN_EXTENT)
    center = 0.5 * (low + high)
    side = _SIZE - _LEFT - _MARGIN

    def at(point: FloatArray) -> tuple[float, float]:
        x, y = (point - center + half) / (2.0 * half)
        return _LEFT + x * side, _MARGIN + (1.0 - y) * side

    parts: list[Markup] = []
    for value in nice_ticks(center[0] - half, center[0] + half, count=4):
        x = at(np.array([value, center[1]]))[0]
        parts.append(element("line", x1=f"{x:.1f}", x2=f"{x:.1f}", y1=_MARGIN, y2=_MARGIN + side, class_="grid"))
        place: dict[str, str | int] = {"x": f"{x:.1f}", "y": _MARGIN + side + 16}
        parts.append(element("text", _tick(value), **place, text_anchor="middle", class_="tick"))
    for value in nice_ticks(center[1] - half, center[1] + half, count=4):
        y = at(np.array([center[0], value]))[1]
        parts.append(element("line", x1=_LEFT, x2=_LEFT + side, y1=f"{y:.1f}", y2=f"{y:.1f}", class_="grid"))
        parts.append(element("text", _tick(value), x=_LEFT - 6, y=f"{y + 4:.1f}", text_anchor="end", class_="tick"))
    parts.append(element("text", label_x, x=_LEFT + side / 2, y=_MARGIN + side + 34, text_anchor="middle"))
    parts.append(
        element("text", label_y, x=12, y=_MARGIN + side / 2, text_anchor="middle",
                transform=f"rotate(-90 12 {_MARGIN + side / 2})")
    )  # fmt: skip
    if truth is not None:
        line = "M" + "L".join("{:.1f} {:.1f}".format(*at(point)) for point in truth)
        dashes: dict[str, str | float] = {"stroke": "currentColor", "stroke_dasharray": "5 3", "stroke_width": 1.2}
        parts.append(element("path", d=line, fill="none", **dashes))
    kept = evenly_spread(len(path), _MAX_SEGMENTS)
    colors = matplotlib.colormaps["viridis"](kept / max(len(path) - 1, 1))[:, :3]
    for first, second, color in zip(kept[:-1], kept[1:], colors, strict=False):
        (x1, y1), (x2, y2) = at(path[first]), at(path[second])
        stroke = "#{:02x}{:02x}{:02x}".format(*(int(255 * c) for c in color))
        ends = {"x1": f"{x1:.1f}", "y1": f"{y1:.1f}", "x2": f"{x2:.1f}", "y2": f"{y2:.1f}"}
        parts.append(element("line", **ends, stroke=stroke, stroke_width=3, stroke_linecap="round"))
    x, y = at(path[0])
    parts.append(
        element("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=5, fill="none", stroke="currentColor", stroke_width=2)
    )
    text = f"{title} of the camera path: {label_x} across, {label_y} upwards, {len(path)} frames."
    return svg(identifier, f"{title} of the camera path", text, _SIZE, _SIZE - _LEFT + _BOTTOM + 6, parts)


def _tick(value: float) -> str:
    return f"{value:.3g}" if abs(value) > 1e-12 else "0"


def uncertainty(run: Run) -> Markup:
    """Return the section with the standard deviation of every camera."""
    title = "Uncertainty of the cameras"
    sigmas = pose_sigmas(run.reconstruction)
    if sigmas is None:
        text = "The run has no covariances: its energy is no likelihood, or it is of an earlier version."
        return section("uncertainty", title, element("p", text))
    position, rotation = sigmas
    frames = list(range(run.num_frames))
    factor, unit = run.small_unit
    charts = [
        figure(
            line_chart("sigma-position", f"Standard deviation of position, {unit}, per frame",
                       [Line("position", frames, (factor * position).tolist())],
                       x_label="frame", y_label=f"position [{unit}]"),
            "Standard deviation of the camera's position",
        ),
        figure(
            line_chart("sigma-rotation", "Standard deviation of orientation, degrees, per frame",
                       [Line("orientation", frames, rotation.tolist())], x_label="frame", y_label="orientation [deg]"),
            "Standard deviation of the camera's orientation",
        ),
    ]  # fmt: skip
    text = (
        "Marginal standard deviations relative to the first camera, which is held. They allow for errors that "
        "neighboring tracks share, not for those of the whole image, such as a distortion of the lens."
    )
    facts = []
    covariance = run.reconstruction.intrinsics_covariance
    if covariance is not None and np.isfinite(covariance).all():
        fx, fy = np.sqrt(np.diagonal(covariance))[:2].tolist()
        held = fx == 0.0 and fy == 0.0
        sentence = "The intrinsics were held." if held else f"Focal lengths: ± {fx:.2g} px (fx), ± {fy:.2g} px (fy)."
        facts.append(element("p", sentence))
    return section("uncertainty", title, element("p", text), *facts, element("div", *charts, class_="charts"))
