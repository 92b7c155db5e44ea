"""What file names tell: gaps in the video, an order that is not meant, cues of other frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from uni4d_fg.frontend.sequence.layout import frame_numbers
from uni4d_fg.frontend.sequence.problems import some_of
from uni4d_fg.frontend.sequence.scan import Findings

_REGULAR_SHARE = 0.8
_REMEDY = "pad the numbers with zeros if the video runs in another order"


def order_warnings(stems: Sequence[str]) -> list[str]:
    """Return a sentence if the numbers that end file names do not increase in the order in which frames are taken."""
    doubt = _unordered(stems, _numbers(stems))
    return [] if doubt is None else [f"{doubt}; {_REMEDY}"]


def _unordered(stems: Sequence[str], numbers: list[int] | None) -> str | None:
    steps = np.diff(numbers) if numbers is not None else np.empty(0)
    if not (steps <= 0).any():
        return None
    at = int(np.flatnonzero(steps <= 0)[0])
    return f"files are taken in the order of their names, in which {stems[at]} comes before {stems[at + 1]}"


def _numbers(stems: Sequence[str]) -> list[int] | None:
    """Return what :func:`frame_numbers` does; None also where points may make the names those of times."""
    return None if any("." in stem for stem in stems) else frame_numbers(stems)


def check_numbering(stems: list[str], findings: Findings) -> None:
    """Warn of numbers that do not increase in name order, and of missing frames."""
    numbers = _numbers(stems)
    doubt = _unordered(stems, numbers)
    if doubt is not None:
        findings.add("warning", "images", doubt, _REMEDY)
        return
    if numbers is None or len(numbers) < 2:
        return
    steps = np.diff(numbers)
    step, times = Counter(steps.tolist()).most_common(1)[0]
    gaps = np.flatnonzero(steps != step)
    if gaps.size and times >= _REGULAR_SHARE * len(steps):
        places = [f"between {stems[i]} and {stems[i + 1]}" for i in gaps.tolist()]
        findings.add(
            "warning",
            "images",
            f"frames seem to be missing {some_of(places, 3)}",
            "add them, or give the true times in timestamps.txt",
        )


def check_pairing(item: str, stems: list[str], image_stems: list[str], findings: Findings) -> None:
    """Compare the names of a cue's files with those of the images, to which they belong in order."""
    if len(stems) != len(image_stems):
        missing = [stem for stem in image_stems if stem not in set(stems)]
        extra = [stem for stem in stems if stem not in set(image_stems)]
        hints = [f"without one: {some_of(missing, 3)}"] if 0 < len(missing) < len(image_stems) else []
        hints += [f"without an image: {some_of(extra, 3)}"] if 0 < len(extra) < len(stems) else []
        text = f" ({'; '.join(hints)})" if hints else ""
        findings.add(
            "error",
            item,
            f"{len(stems)} files for {len(image_stems)} images{text}",
            "give exactly one file per image",
        )
        return
    own, images = _numbers(stems), _numbers(image_stems)
    if own is None or images is None:
        return
    offsets = np.array(own) - np.array(images)
    # A constant offset is another way of counting, unless both count alike and a file lacks at one end.
    renumbered = (offsets == offsets[0]).all() and set(own).isdisjoint(images)
    if (offsets != 0).any() and not renumbered:
        at = int(np.flatnonzero(offsets)[0])
        findings.add(
            "warning",
            item,
            f"files belong to images in the order of their names, in which {stems[at]} goes with {image_stems[at]}",
            "name the files like their images",
        )
