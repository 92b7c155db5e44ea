"""How well observations are explained, and which were left out and why."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.colors import css_gradient, value_range
from uni4d_fg.results.pictures.figure import spread_frames
from uni4d_fg.results.report.chart import Line, line_chart
from uni4d_fg.results.report.images import residual_picture
from uni4d_fg.results.report.markup import Markup, color_bar, element, figure, picture, section, table
from uni4d_fg.results.residuals import Residuals
from uni4d_fg.results.run import Run

_MAPS = 4
_MAP_WIDTH = 640


def residual_maps(run: Run, residuals: Residuals | None) -> Markup:
    """Return the section with the residual of each observation drawn on frames, and of each frame."""
    title = "Reprojection residuals"
    if residuals is None:
        return section("residuals", title, element("p", "The run has no tracks to compute them from.", class_="muted"))
    frames = list(range(run.num_frames))
    lines = []
    for dynamic, name in ((False, "static"), (True, "moving")):
        if (residuals.is_dynamic == dynamic).any():
            for quantile, label in ((0.5, "median"), (0.9, "90 % below")):
                values = residuals.per_frame(run.num_frames, quantile, dynamic=dynamic).tolist()
                lines.append(Line(f"{name}, {label}", frames, values))
    chart = line_chart(
        "residual-frames", "Reprojection residual per frame, px", lines, x_label="frame", y_label="residual [px]"
    )
    static, moving = (residuals.norm[residuals.is_dynamic == dynamic] for dynamic in (False, True))
    facts = [f"static points: median {np.median(static):.2f} px over {len(static)} observations"] if len(static) else []
    if len(moving):
        facts.append(f"moving points: median {np.median(moving):.2f} px over {len(moving)}")
    text = (
        ", ".join(facts).capitalize() + ". " if facts else ""
    ) + "Every trusted observation of a point counts, also those that bundle adjustment left out for their residual."
    return section(
        "residuals", title, element("p", text), element("div", figure(chart, "Per frame"), class_="charts"),
        *_maps(run, residuals),
    )  # fmt: skip


def _maps(run: Run, residuals: Residuals) -> list[Markup]:
    if run.sequence is None or run.labelled is None:
        return [element("p", "Without images there are no maps.", class_="muted")]
    bounds = value_range(residuals.norm)
    tracks = run.labelled.tracks
    used = np.zeros(tracks.num_tracks, dtype=bool)
    used[run.reconstruction.landmark_track] = True
    used[run.reconstruction.dynamic_track] = True
    shown = []
    for frame in spread_frames(run.num_frames, _MAPS):
        here = residuals.frame == frame
        unused = tracks.uv[~used & tracks.visible[:, frame], frame].astype(np.float64)
        image = residual_picture(
            run.sequence.images[frame], residuals.uv[here], residuals.norm[here], residuals.is_dynamic[here], unused,
            bounds, _MAP_WIDTH,
        )  # fmt: skip
        middle = f"median {np.median(residuals.norm[here]):.2f} px" if here.any() else "no observation"
        caption = f"frame {frame}: {int(here.sum())} observations, {middle}; {len(unused)} of tracks not used"
        shown.append(figure(picture(image, f"Residual map of {caption}"), caption))
    return [
        element("h3", "Residual maps"),
        color_bar(css_gradient(), "0 px", f"{bounds[1]:.2g} px and more", "Residual"),
        element("div", *shown, class_="maps"),
        element("p", "Discs: static points. Squares: moving points. Gray crosses: tracks not used.", class_="muted"),
    ]


def dropped(run: Run) -> Markup:
    """Return the section about what was left out, with reasons."""
    stages = run.summary.get("stages", {})
    parts: list[Markup] = []
    tracks = stages.get("tracks", {}).get("tracks", {})
    total = sum(tracks.values())
    if total:
        rows = [[name.replace("_", " "), str(n), f"{100 * n / total:.1f} %"] for name, n in tracks.items()]
        parts.append(table(f"What the {total} tracks were taken to be", ("label", "tracks", "share"), rows))
        text = "Rejected tracks mix static and moving things, switch between instances, or were never surely seen."
        parts.append(element("p", text, class_="muted"))
    rows = [
        [reason, name.replace("_", " "), str(count)]
        for name, stage in stages.items() for reason, count in stage.get("dropped", {}).items() if count
    ]  # fmt: skip
    if rows:
        parts.append(table("Left out by the stages", ("reason", "stage", "count"), rows))
    else:
        parts.append(element("p", "No stage left anything out."))
    kept = run.reconstruction
    bridged = int((np.isfinite(kept.dynamic_points).all(axis=2) & ~kept.dynamic_observed).sum())
    if bridged:
        share = 100 * bridged / max(int(np.isfinite(kept.dynamic_points).all(axis=2).sum()), 1)
        parts.append(
            element("p", f"{bridged} positions of moving points ({share:.1f} %) are bridged: not seen in their frame.")
        )
    return section("dropped", "What was left out", *parts)
