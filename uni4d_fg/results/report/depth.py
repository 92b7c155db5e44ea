"""Depth before and after: image, cue and fused depth of some frames."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.colors import depth_bounds
from uni4d_fg.results.pictures.figure import spread_frames, thumbnail
from uni4d_fg.results.report.chart import Line, line_chart
from uni4d_fg.results.report.images import depth_gradient, depth_picture
from uni4d_fg.results.report.markup import Markup, color_bar, element, figure, picture, section
from uni4d_fg.results.run import Run

_COLUMNS = 5
_WIDTH = 300


def depth_strips(run: Run) -> Markup:
    """Return the section with strips of depth, and the scale that every frame's cue was given."""
    return section("depth", "Depth", *_strips(run), _scales(run))


def _strips(run: Run) -> list[Markup]:
    frames = spread_frames(run.num_frames, _COLUMNS)
    cues = None if run.sequence is None else run.sequence.depths
    sources = {name: source for name, source in (("Depth cue", cues), ("Fused depth", run.depth)) if source is not None}
    maps = {name: [np.asarray(source[frame]) for frame in frames] for name, source in sources.items()}
    if not maps and run.sequence is None:
        return [element("p", "Neither images nor depth are at hand.", class_="muted")]
    out: list[Markup] = []
    style = f"--columns:{len(frames)}"
    if run.sequence is not None:
        tiles = [
            figure(picture(thumbnail(run.sequence.images[frame], _WIDTH), f"Image of frame {frame}"), f"frame {frame}")
            for frame in frames
        ]
        out += [element("h3", "Image"), element("div", *tiles, class_="strip", style=style)]
    if not maps:
        return out
    bounds = depth_bounds([depth for row in maps.values() for depth in row])
    for name, row in maps.items():
        tiles = []
        for frame, depth in zip(frames, row, strict=True):
            known = depth[np.isfinite(depth) & (depth > 0)]
            middle = f", median {np.median(known):.3g} {run.unit}" if known.size else ", none known"
            tiles.append(
                figure(
                    picture(depth_picture(depth, bounds, _WIDTH), f"{name} of frame {frame}{middle}"), f"frame {frame}"
                )
            )
        out += [element("h3", name), element("div", *tiles, class_="strip", style=style)]
    near, far = (f"{bound:.3g} {run.unit}" for bound in bounds)
    out.append(color_bar(depth_gradient(), near, far, "Depth"))
    out.append(element("p", "Both rows share the colors, which are logarithmic. Gray: no depth.", class_="muted"))
    return out


def _scales(run: Run) -> Markup:
    scales = np.exp(run.reconstruction.depth_log_scale)
    chart = line_chart(
        "depth-scale", "Factor that the depth cue of each frame is multiplied by",
        [Line("factor", list(range(run.num_frames)), (100.0 * (scales - 1.0)).tolist())],
        x_label="frame", y_label="cue too small by [%]",
    )  # fmt: skip
    return element("div", figure(chart, "By how much the cue of each frame is too small"), class_="charts")
