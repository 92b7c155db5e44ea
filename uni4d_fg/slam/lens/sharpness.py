"""Frames that are sharp enough to tell a lens.

What is blurred by motion is found a little off along it. A turn moves the image farther where it is farther from its
middle, so that such errors grow outward, as the displacements of a lens do: from frames of a fast pan a weak lens is
found that is none, with a focal length some percent off.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array

_BLURRED_PX = 6.0
"""Blur, px, from which on a frame is not asked ..."""
_LEAST = 0.5
"""... as long as this part of all frames is left."""


def sharp_frames(blur_px: Float32Array | None, num_frames: int) -> BoolArray:
    """Return the frames (T,) that are asked for a lens: sharp ones, or all where those are too few.

    Args:
        blur_px: (T,) length of the motion blur of each frame; None where it is not known.
        num_frames: T.
    """
    every = np.ones(num_frames, dtype=bool)
    if blur_px is None:
        return every
    sharp = blur_px < _BLURRED_PX
    return sharp if sharp.mean() >= _LEAST else every
