"""From when on cameras of motion are doubted: what a run warns of, and what its report explains."""

from __future__ import annotations

OPEN_FOCAL = 0.06
"""An interval of focal lengths that reaches farther than this part of the focal length is warned of."""
RIVAL_DEGREES = 5.0
"""Cameras of another start that are turned by more than this against the result are warned of, ..."""
RIVAL_DEGREES_PER_FRAME = 0.5
"""... and those whose turns from frame to frame differ by more than this."""
LITTLE_PARALLAX = 30.0
"""Parallax of the median track of less than this, in standard deviations of the tracks' noise, is warned of."""
MUCH_UNEXPLAINED = 0.6
"""More than this part of what was held out is warned of."""
