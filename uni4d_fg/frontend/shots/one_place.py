"""Do two frames show one place? By SIFT features that a similarity takes from one to the other.

Corners that are followed are lost in the blur of a fast pan, and what lies between its ends looks like a blend of both.
Features need not be followed. Of two frames of different shots a dozen never agree: of 250 pairs of rendered clips 7
did at most; across a blurred pan of 15 frames a second, before plain walls, dozens; and 13 to 60 of two frames of a
room through which three people walk, whose shirts have more features than its walls.
"""

from __future__ import annotations

import cv2
import numpy as np

from uni4d_fg.arrays import ImageArray
from uni4d_fg.frontend.shots.links import has_plausible_scale, small_gray

_WIDTH = 640
"""Longer side of the images that are compared, at most, px: half as large, what is far has too few features."""
_FEATURES = 800
_DISTINCT = 0.8
"""A feature is matched whose best match is nearer than this part of the distance of the second."""
_ERROR_PX = 3.0
_MOST_ROLL = np.radians(45.0)
"""Shots of one place that is seen upside down are two."""
_LEAST = 12
"""Features that must agree."""


def show_one_place(one: ImageArray, other: ImageArray) -> bool:
    """Tell whether two frames, (H, W, 3) or (H, W), uint8, show one place, from about the same side."""
    (here, described), (there, described_other) = _features(one), _features(other)
    if min(len(here), len(there)) < _LEAST:
        return False
    pairs = [
        found[0]
        for found in cv2.BFMatcher().knnMatch(described, described_other, k=2)
        if found[0].distance < _DISTINCT * found[1].distance
    ]
    if len(pairs) < _LEAST:
        return False
    source = here[[pair.queryIdx for pair in pairs]]
    target = there[[pair.trainIdx for pair in pairs]]
    moved, agrees = cv2.estimateAffinePartial2D(source, target, method=cv2.RANSAC, ransacReprojThreshold=_ERROR_PX)
    if moved is None or not has_plausible_scale(moved):
        return False
    if abs(np.arctan2(moved[1, 0], moved[0, 0])) > _MOST_ROLL:
        return False
    return int(np.count_nonzero(agrees)) >= _LEAST


def _features(image: ImageArray) -> tuple[np.ndarray, np.ndarray]:
    """Return where features (N, 2) are, and what they look like (N, 128)."""
    gray = small_gray(image, _WIDTH)
    detector = cv2.SIFT_create(nfeatures=_FEATURES)  # type: ignore[attr-defined]
    points, described = detector.detectAndCompute(gray, None)
    if described is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in points]), described
