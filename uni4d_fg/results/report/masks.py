"""What was masked: the instances in their colors over some of the frames."""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import ImageArray, Int32Array
from uni4d_fg.counted import counted
from uni4d_fg.results.colors import instance_colors
from uni4d_fg.results.pictures.figure import spread_frames, thumbnail
from uni4d_fg.results.report.markup import Markup, element, figure, join, picture, section, swatches
from uni4d_fg.results.run import Run

_COLUMNS = 5
_WIDTH = 300
_STRENGTH = 0.55
_OUTLINE_PX = 2
_MOST_NAMED = 12


def mask_strip(run: Run) -> Markup:
    """Return the section with the masks over the frames."""
    title = "Masks"
    sequence = run.sequence
    if sequence is None:
        return section("masks", title, element("p", "Without images there are no masks to show.", class_="muted"))
    if sequence.masks is None:
        return section("masks", title, element("p", "No masks were used: everything counts as static."))
    frames = spread_frames(run.num_frames, _COLUMNS)
    tiles, shares = [], []
    seen: set[int] = set()
    for frame in frames:
        mask = np.asarray(sequence.masks[frame])
        share = 100.0 * float(np.mean(mask > 0))
        here = sorted(np.unique(mask[mask > 0]).tolist())
        seen.update(here)
        shares.append(share)
        instances = counted(len(here), "instance") if here else "nothing"
        alternative = f"Masks of frame {frame}: {instances}, {share:.1f} % of the picture"
        tiles.append(
            figure(
                picture(mask_picture(sequence.images[frame], mask, _WIDTH), alternative),
                f"frame {frame}: {share:.1f} % masked",
            )
        )
    strip = element("div", *tiles, class_="strip", style=f"--columns:{len(frames)}")
    return section("masks", title, element("p", _said(seen, shares)), strip, _legend(run, sorted(seen)))


def mask_picture(image: ImageArray, mask: Int32Array, width: int) -> ImageArray:
    """Return an image (H, W, 3) no wider than ``width``, its instances tinted and outlined in their colors.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W) labels, 0 static.
        width: px.
    """
    small = thumbnail(image, width)
    height, columns = small.shape[:2]
    labels = cv2.resize(mask.astype(np.int32), (columns, height), interpolation=cv2.INTER_NEAREST)
    out = small.copy()
    inside = labels > 0
    tint = instance_colors(labels)
    mixed = (1.0 - _STRENGTH) * small[inside] + _STRENGTH * tint[inside]
    out[inside] = np.rint(mixed).astype(np.uint8)
    for instance in np.unique(labels[inside]).tolist():
        outlines, _ = cv2.findContours((labels == instance).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        color = instance_colors(np.array([instance]))[0].tolist()
        cv2.drawContours(out, outlines, -1, color, _OUTLINE_PX)
    return out


def _said(seen: set[int], shares: list[float]) -> str:
    if not seen:
        return "In none of these frames is anything masked: everything in them counts as static."
    return (
        f"What may move is tinted, a color for each instance: {min(shares):.1f} to {max(shares):.1f} % of these "
        "frames. A moving thing without a color bends the cameras; a colored thing that stands still costs support."
    )


def _legend(run: Run, instances: list[int]) -> Markup:
    """Return every instance with its color and how many trajectories it has."""
    if not instances:
        return Markup("")
    of = run.reconstruction.dynamic_instance
    named = []
    for instance in instances[:_MOST_NAMED]:
        count = int((of == instance).sum())
        moving = counted(count, "trajectory", "trajectories") if count else "no trajectory"
        named.append((f"instance {instance}: {moving}", instance_colors(np.array([instance]))[0].tolist()))
    rest = len(instances) - _MOST_NAMED
    return join([swatches(named), element("p", f"And {rest} more.", class_="muted") if rest > 0 else Markup("")])
