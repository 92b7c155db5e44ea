"""What to distrust of cameras from motion alone, and which quantities the motion leaves open."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.cues.start_limits import (
    LITTLE_PARALLAX,
    MUCH_UNEXPLAINED,
    OPEN_FOCAL,
    RIVAL_DEGREES,
    RIVAL_DEGREES_PER_FRAME,
)
from uni4d_fg.cues.structure.motion import Structure
from uni4d_fg.cues.structure.rivals import rotation_difference
from uni4d_fg.frontend.sequence.problems import some_of

_FEW_FRAMES = 0.5
"""Fewer frames with a pose than this part of the video are warned of."""


def start_doubts(structure: Structure, remedy: str = "give K.npy if it is known") -> list[str]:
    """Return one sentence for everything that a reader should know of the cameras.

    Args:
        structure: Cameras and what is known of them.
        remedy: What to do about a focal length that is open.
    """
    warnings = []
    bridged = np.flatnonzero(~structure.registered).tolist()
    if bridged:
        severe = len(bridged) > (1.0 - _FEW_FRAMES) * len(structure.registered)
        warnings.append(
            f"{len(bridged)} frame(s) see too few points of the static scene, and their cameras are only interpolated"
            f"{' (most of the video: do not trust this result)' if severe else ''}: {some_of(bridged)}"
        )
    warnings += _open_focal(structure, remedy) + _denied_lens(structure, remedy) + _little_parallax(structure)
    return warnings + _doubtful_start(structure)


def doubts_of_masks(before: FloatArray, after: FloatArray) -> list[str]:
    """Return a sentence if masks from motion changed the cameras much that they were made with.

    Args:
        before: (T, 4, 4) cameras from all tracks.
        after: (T, 4, 4) cameras from the tracks outside the masks.
    """
    degrees, per_frame = rotation_difference(before, after, np.arange(len(before)))
    if degrees <= RIVAL_DEGREES and per_frame <= RIVAL_DEGREES_PER_FRAME:
        return []
    return [
        f"the cameras turned by {degrees:.0f} degrees ({per_frame:.2f} per frame) when what seems to move was masked: "
        "what was taken for the static scene may be a moving thing; look at the masks, or give some"
    ]


def _open_focal(structure: Structure, remedy: str) -> list[str]:
    focal = float(np.mean(structure.intrinsics[:2]))
    if structure.focal.reach(focal) <= OPEN_FOCAL:
        return []
    below, above = structure.focal.relative(focal)
    low = "any shorter one" if structure.focal.low_is_open else f"{structure.focal.low:.0f}"
    high = "any longer one" if structure.focal.high_is_open else f"{structure.focal.high:.0f} px"
    return [
        f"this video leaves the focal length open: {focal:.0f} px was found, but from {low} to {high} explain the "
        f"tracks as well; depth, and motion along the viewing direction, stretch with it ({100 * below:+.0f} to "
        f"{100 * above:+.0f} %); {remedy}"
    ]


def _denied_lens(structure: Structure, remedy: str) -> list[str]:
    if structure.denied_px == 0.0:
        return []
    by = f" (by up to {structure.denied_px:.0f} px)" if np.isfinite(structure.denied_px) else ""
    return [
        f"the tracks ask for distortion that no lens has{by}: the cameras, which do without it, may be wrong, as where "
        f"tracks are bad or the camera hardly moves; {remedy}"
    ]


def _little_parallax(structure: Structure) -> list[str]:
    if structure.parallax_px >= LITTLE_PARALLAX * structure.sigma_px:
        return []
    return [
        f"the camera hardly moves for what it sees: the tracks' median parallax is {structure.parallax_px:.1f} px, and "
        f"their noise {structure.sigma_px:.2f} px; its turns are found, but its path and depth may be poor"
    ]


def _doubtful_start(structure: Structure) -> list[str]:
    warnings = []
    if structure.unexplained > MUCH_UNEXPLAINED:
        warnings.append(
            f"the cameras found explain only {100 * (1.0 - structure.unexplained):.0f} % of the tracks that were held "
            "out to judge them: much may move, or the tracks are bad; look before you trust them, or give masks"
        )
    against = [
        rival
        for rival in structure.rivals
        if rival.degrees > RIVAL_DEGREES or rival.degrees_per_frame > RIVAL_DEGREES_PER_FRAME
    ]
    if against:
        worst = max(against, key=lambda rival: rival.degrees)
        here, there = (100 * (1.0 - part) for part in (structure.unexplained, worst.unexplained))
        warnings.append(
            f"the cameras are ambiguous: a start from frames {worst.first} and {worst.second} explains the tracks "
            f"nearly as well ({there:.0f} against {here:.0f} %) with cameras turned by {worst.degrees:.0f} degrees "
            f"({worst.degrees_per_frame:.2f} per frame); give masks of what moves, or K.npy"
        )
    return warnings


def start_summary(structure: Structure) -> dict[str, Any]:
    """Return what is open, as plain data for the summary of a run."""
    focal = float(np.mean(structure.intrinsics[:2]))
    below, above = structure.focal.relative(focal)
    return {
        "focal_px": focal,
        "focal_interval_px": [structure.focal.low, structure.focal.high],
        "focal_is_open": [structure.focal.low_is_open, structure.focal.high_is_open],
        "stretch_along_view": [1.0 + below, 1.0 + above],
        "parallax_px": structure.parallax_px,
        "noise_px": structure.sigma_px,
        "unexplained": structure.unexplained,
        "registered": float(np.mean(structure.registered)),
        "starts": [asdict(rival) for rival in structure.rivals],
    }
