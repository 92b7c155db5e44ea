"""In plain words: what the video leaves open, and how certain the cameras are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from uni4d_fg.counted import counted
from uni4d_fg.cues.start_limits import LITTLE_PARALLAX, MUCH_UNEXPLAINED, OPEN_FOCAL, RIVAL_DEGREES
from uni4d_fg.results.measures import pose_sigmas, scene_depth
from uni4d_fg.results.report.markup import Markup, bullets, fold, number, section, table
from uni4d_fg.results.run import Run

_CERTAIN = 0.005
"""A position that is known to this part of the scene's depth is well determined."""
_UNCERTAIN = 0.02


def certainty(run: Run) -> Markup:
    """Return the section that says in plain words what is certain and what is not."""
    facts = [*_scale(run), *_start(run), *_cameras(run)]
    starts = _starts_table(run)
    return section("certainty", "What is certain, and what is not", bullets(facts), *starts)


def _scale(run: Run) -> Iterator[str]:
    if run.depth_is_unknown:
        yield (
            "Nothing is known of depth: the camera stays in one place, and everything was put at one distance. "
            "Rotations are real; positions, points and clouds are not."
        )
    elif run.is_metric:
        yield (
            "Lengths are as long as the depth cue says: if all of its depth is too large by a factor, so is everything "
            "here, and nothing in the video can tell."
        )
    else:
        yield "Lengths have no unit: everything is right up to one factor, which nothing in the video can tell."


def _start(run: Run) -> Iterator[str]:
    """Say what motion alone left open, where cameras were found from it."""
    start = _recorded_start(run)
    (low, high), focal = start.get("focal_interval_px", (None, None)), start.get("focal_px")
    if focal is not None and low is not None and high is not None:
        is_open = start.get("focal_is_open", (False, False))
        reach = max(focal - low, high - focal) / focal
        if any(is_open) or reach > OPEN_FOCAL:
            below = "any shorter focal length" if is_open[0] else f"{low:.0f} px"
            above = "any longer one" if is_open[1] else f"{high:.0f} px"
            yield (
                f"The focal length is open: {focal:.0f} px was found from motion, but everything from {below} to "
                f"{above} explains it as well. Depth stretches along the view with it{_stretch(start)}."
            )
        else:
            yield (
                f"Motion alone fixes the focal length at {focal:.0f} px: outside of {low:.0f} to {high:.0f} px the "
                "tracks fit worse."
            )
    parallax, noise = start.get("parallax_px"), start.get("noise_px")
    if parallax is not None and noise is not None:
        is_little = parallax < LITTLE_PARALLAX * noise
        verdict = "that is little: path and depth may be poor" if is_little else "enough to tell its path"
        yield (
            f"The camera's motion shows the median track's point from sides that are {parallax:.1f} px apart in the "
            f"image, beside {noise:.2f} px of noise ({verdict})."
        )
    unexplained = start.get("unexplained")
    if unexplained is not None:
        verdict = "that is little: much may move, or tracks are bad" if unexplained > MUCH_UNEXPLAINED else "as usual"
        yield (
            f"The first cameras explain {100 * (1 - unexplained):.0f} % of the tracks that were held out to judge them "
            f"({verdict})."
        )
    starts = start.get("starts", [])
    if starts:
        turned = max(rival.get("degrees") or 0.0 for rival in starts)
        if turned > RIVAL_DEGREES:
            yield (
                "The cameras are ambiguous: another start of the search explains the tracks nearly as well, with "
                f"cameras that are turned by {turned:.0f} degrees."
            )
        else:
            yield (
                f"{counted(len(starts), 'other start')} of the search that explained the tracks nearly as well gave "
                f"the same cameras, within {turned:.1f} degrees."
            )


def _recorded_start(run: Run) -> dict[str, Any]:
    start: dict[str, Any] = run.summary.get("cues", {}).get("start", {})
    return start


def _stretch(start: dict[str, Any]) -> str:
    low, high = start.get("stretch_along_view", (None, None))
    return "" if low is None or high is None else f", by {100 * (low - 1):+.0f} to {100 * (high - 1):+.0f} %"


def _cameras(run: Run) -> Iterator[str]:
    """Say what the covariances mean."""
    sigmas = pose_sigmas(run.reconstruction)
    if sigmas is None or run.num_frames < 2:
        yield "How certain the cameras are is not known: the run has no covariances."
        return
    position, rotation = sigmas
    known = np.isfinite(position) & np.isfinite(rotation)
    known[0] = False
    if not known.any():
        yield "The data do not determine the cameras: their covariances are infinite."
        return
    factor, unit = run.small_unit
    depth = scene_depth(run.reconstruction)
    middle, worst = float(np.median(position[known])), int(np.argmax(np.where(known, position, -1.0)))
    share = middle / depth
    verdict = (
        "well determined" if share < _CERTAIN else "poorly determined" if share > _UNCERTAIN else "fairly determined"
    )
    yield (
        f"The cameras are {verdict}: relative to the first frame, a position is typically off by about "
        f"{number(factor * middle, 2)} {unit} ({number(100 * share, 2)} % of the scene's depth) and an orientation by "
        f"{number(float(np.median(rotation[known])), 2)} degrees. The least certain is frame {worst}, with "
        f"{number(factor * position[worst], 2)} {unit}. This is what noise of the tracks and of the cue does; wrong "
        "masks and lens distortion come on top."
    )


def _starts_table(run: Run) -> list[Markup]:
    starts = _recorded_start(run).get("starts", [])
    if not starts:
        return []
    rows = [
        [
            f"{rival.get('first')} and {rival.get('second')}", number(rival.get("degrees"), 3),
            number(rival.get("degrees_per_frame"), 3), "–" if left is None else f"{100 * (1 - left):.0f} %",
        ]
        for rival in starts
        for left in [rival.get("unexplained")]
    ]  # fmt: skip
    head = ("frames it started from", "turned by, deg", "per frame, deg", "explains")
    caption = "Other starts of the search for cameras"
    return [fold(caption, table(caption, head, rows))]
