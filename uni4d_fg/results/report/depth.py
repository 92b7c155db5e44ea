"""Depth before and after: image, cue and fused depth of some frames."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.colors import depth_bounds
from uni4d_fg.results.depth_agreement import depth_disagreement
from uni4d_fg.results.pictures.figure import spread_frames, thumbnail
from uni4d_fg.results.report.chart import Line, line_chart
from uni4d_fg.results.report.images import depth_gradient, depth_picture
from uni4d_fg.results.report.markup import Markup, bullets, color_bar, element, figure, picture, section
from uni4d_fg.results.run import Run

_COLUMNS = 5
_WIDTH = 300
_CHECKED = 6
"""Frames, or pairs of them, from which the quality is told."""
_APART = 0.1
"""Of the video, between the frames of a pair."""


def depth_strips(run: Run) -> Markup:
    """Return the section with the quality of depth, strips of it, and the scale that every frame's cue was given."""
    return section("depth", "Depth", _quality(run), *_strips(run), _scales(run))


def _quality(run: Run) -> Markup:
    """Say what is known of the dense depth without any ground truth."""
    facts = [_sentence(str(fact)) for fact in run.summary.get("stages", {}).get("fusion", {}).get("facts", [])]
    depth, sequence, result = run.depth, run.sequence, run.reconstruction
    if depth is not None:
        shares = [float(np.mean(np.asarray(depth[frame]) > 0)) for frame in spread_frames(run.num_frames, _CHECKED)]
        facts.append(f"Fused depth is known for {100 * np.mean(shares):.1f} % of the pixels.")
    apart = max(1, round(run.num_frames * _APART))
    pairs = [(frame, frame + apart) for frame in spread_frames(run.num_frames - apart, _CHECKED)]
    masks = None if sequence is None else sequence.masks
    differences: dict[str, np.ndarray] = {}
    if pairs and depth is not None:
        differences["fused"] = depth_disagreement(depth, result, masks, pairs)
    if pairs and sequence is not None and sequence.depths is not None:
        differences["cue"] = depth_disagreement(sequence.depths, result, masks, pairs, result.depth_log_scale)
    said = [
        f"{name} depth by {100 * np.median(values):.2g} % (a tenth of the pixels by more than "
        f"{100 * np.quantile(values, 0.9):.2g} %)"
        for name, values in differences.items() if values.size
    ]  # fmt: skip
    if said:
        facts.append(
            f"Carried by the cameras between frames that are {apart} apart, static pixels differ in the median: "
            f"{'; '.join(said)}. What is hidden in one of both frames differs as well."
        )
    return bullets(facts) if facts else Markup("")


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


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
        x_label="frame", y_label="scale correction [%]",
    )  # fmt: skip
    return element(
        "div",
        figure(chart, "How much the depth of each frame was scaled: above zero, the cue was too small"),
        class_="charts",
    )
