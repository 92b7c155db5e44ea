"""Whether a video's depth is matched over several views or the corrected cue: what landmarks say of both, and edges."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.fusion.static_depth import HeldOut

_SHARP_PX = 4.0
"""Matching blurs edges by this itself: a cue that is found to bleed no farther has the detail of edges, working px."""
_BETTER = 1.0
"""Matched depth is used if its error at landmarks is below this part of the corrected cue's ..."""
_NOT_WORSE = 1.5
"""... and below this one if the cue bleeds: landmarks do not lie on edges."""
_FAR_WORSE = 4.0
"""If depth that was matched without comparing frames is above this in one frame, nothing more is tried."""
_POOR = 0.04
"""Noise, a standard deviation of the log depth, from which a cue is a network's."""
_POOR_BLEEDS_PX, _NOT_WORSE_THAN_POOR = 6.0, 3.0
"""A poor cue bleeds across edges by the first, working px of the usual size, at least, whether a few frames show it or
not, and only matched depth has its edges right. Landmarks prefer it all the same, as others beside them made or
corrected it: matched depth is used below the second."""


def is_poor(noise: float, depth_parallax: bool | None) -> bool:
    """Tell whether a cue has no edges of its own: a network's, or depth that was interpolated between points.

    Args:
        noise: Of the cue at landmarks, a standard deviation of the log depth.
        depth_parallax: Whether depth from motion saw any; None for depth that was given.
    """
    return noise > _POOR or depth_parallax is True


def adds_nothing(errors: HeldOut) -> bool:
    """Tell from a frame that was matched without comparing frames whether nothing more need be tried."""
    return errors.telling and errors.matching > _FAR_WORSE


def tells_bleeding(errors: HeldOut) -> bool:
    """Tell whether matched depth is good enough to see by it how far the cue bleeds.

    A cue that was made from landmarks is not judged by them.
    """
    return _counts(errors, _NOT_WORSE, bleeds=True)


def bleeding_of(radius: float, *, poor: bool, finer: float = 1.0) -> float:
    """Return how far a cue bleeds, working px; 0 for one that has the detail of edges.

    Args:
        radius: As edges tell, working px; NaN if they do not.
        poor: See :func:`is_poor`.
        finer: How many times as fine as usual the working size is.
    """
    radius = max(radius if np.isfinite(radius) else 0.0, finer * _POOR_BLEEDS_PX if poor else 0.0)
    return radius if radius > _SHARP_PX else 0.0


def is_preferred(errors: HeldOut, bleeding_px: float, *, poor: bool) -> bool:
    """Tell whether matched depth is the better one, as far as a frame says.

    Args:
        errors: Of both in the frame.
        bleeding_px: How far the cue bleeds, see :func:`bleeding_of`.
        poor: See :func:`is_poor`.
    """
    if bleeding_px == 0:
        return _counts(errors, _BETTER, bleeds=False)
    return _counts(errors, _NOT_WORSE_THAN_POOR if poor else _NOT_WORSE, bleeds=True)


def _counts(errors: HeldOut, limit: float, *, bleeds: bool) -> bool:
    return errors.matching < limit or (bleeds and not errors.telling)
