"""How sure static depth is once frames are averaged, and how far it is off in the mean, fitted to scenes with truth.

The probability that a pixel is right to 3 % is a logistic function of what its own frame says, of the other frames
that see it, of the edges beside it, and where the cue bleeds of how far depth bends. The mean error is a geometric
mean of two estimates that err differently: the error that goes with such probabilities on scenes with truth, which
counts for more, and how far landmarks are from the depth at pixels as sure as theirs. (Landmarks do not see the errors
that they share with the depth, those of the cameras. They also lie on texture, where depth is best, and beside edges,
where it is worst: comparing equally sure pixels takes this out, in part.) What focal lengths that are not well known
make of depth (:mod:`uni4d_fg.slam.stages.focal_depth_error`) is an error of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray
from uni4d_fg.results.fusion.averaging import Averaged
from uni4d_fg.results.fusion.log_range import log_range
from uni4d_fg.results.fusion.matching_size import times_finer

_WEIGHTS = np.array([-2.2, 0.554, 3.029, 0.499, -2.556], dtype=np.float32)
_MANY_FRAMES = 4
_PLAIN, _PLAINER = np.float32(0.008), 2
"""Gray values that vary by less than this (of 1, at the usual working size) are plain, and the power: fitted to a room,
a street, and a table before a plain wall."""
_TOO_SURE, _LESS_SURE = np.float32(2.6), np.float32(0.62)
"""Odds beyond which depth from motion alone is right less often than they say, and the power of what is beyond: fitted
to fifteen rendered clips."""
_EDGE_WINDOW = np.ones((5, 5), np.uint8)
_STEEPEST = np.float32(0.3)
_UNBENT, _BENT_WEIGHT = np.float32(1.0), np.float32(-2.2)
"""Both fitted; of the constant, 2.3 by the fit, less than half is taken, so that less of the cloud is off."""
_MOST_BENT = np.float32(0.015)
"""Relative bend of inverse depth over neighboring pixels from which on depth is as likely between two surfaces."""
_BESIDE_WINDOW = np.ones((3, 3), np.uint8)
_BINS = np.array([0.3, 0.6, 0.8, 0.9, 0.95, 0.98])
_SURENESS = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0], np.float32)
_ERRORS = np.array([0.16, 0.05, 0.029, 0.0155, 0.0095, 0.0045, 0.0025], np.float32)
"""Mean errors at these probabilities, linear in between: of clips of two renderers, with cues as networks make them."""
_FROM_MOTION = np.array([0.125, 0.066, 0.049, 0.04, 0.0232, 0.0102, 0.007], np.float32)
"""The same where the cue was interpolated between static points: medians of nine clips of a third renderer, and of two
recordings."""
_PRIOR_SHARE = 0.8
"""Of what is told, in the logarithm, that such errors have; the rest is the landmarks'."""
_MIN_COMPARED = 10
_SIGMA_TO_MEAN = float(np.sqrt(2 / np.pi))


def final_confidence(alone: Float32Array, averaged: Averaged, *, bleeds: bool = False) -> Float32Array:
    """Return the probability (h, w) that depth is right to 3 %; 0 where there is none.

    Args:
        alone: (h, w) the same, as the frame alone says.
        averaged: Depth, and what the other frames say of it.
        bleeds: The cue bleeds across edges: where depth bends, it may lie between two surfaces.
    """
    log_depth = averaged.log_depth
    missing = ~np.isfinite(log_depth)
    steep = np.minimum(log_range(log_depth, _EDGE_WINDOW), _STEEPEST)
    bounded = np.clip(alone, np.float32(1e-3), np.float32(1 - 1e-3))
    share = averaged.alike / np.maximum(averaged.seeing, 1)
    seen = np.minimum(averaged.seeing, _MANY_FRAMES) / _MANY_FRAMES
    features = np.log(bounded / (1 - bounded)), share, seen, steep
    value = sum((weight * feature for weight, feature in zip(_WEIGHTS[1:], features, strict=True)), _WEIGHTS[0])
    if bleeds:
        value = value + _UNBENT + _BENT_WEIGHT * np.minimum(_bend(log_depth) / _MOST_BENT, np.float32(1))
    probability = 1 / (1 + np.exp(-value))
    probability[missing] = 0
    return np.asarray(probability, np.float32)


def without_texture(sure: Float32Array, gray: Float32Array, radius: int) -> Float32Array:
    """Return probabilities (h, w) that are less where the image is plain, for depth that nothing else tells.

    What borders on a plain surface carries its depth over to it, in all frames alike, so that these agree: also where
    the window that was compared lies across the border, as its texture is then the other surface's. The odds fall with
    a power of what gray values vary by in the plainest window that holds the pixel.

    Args:
        sure: (h, w).
        gray: (h, w), of 1; NaN where missing.
        radius: Half side of the window, working px of the usual size.
    """
    finer = times_finer(gray.shape)
    window = (2 * round(finer * radius) + 1,) * 2
    known = np.isfinite(gray)
    value = np.where(known, gray, np.float32(0))
    share = np.maximum(cv2.blur(known.astype(np.float32), window), np.float32(1e-6))
    mean, square = (cv2.blur(part, window) / share for part in (value, value * value))
    varies = np.where(share > np.float32(1e-6), np.sqrt(np.maximum(square - mean * mean, 0)), np.float32(1))
    varies = cv2.erode(varies, np.ones(window, np.uint8))
    odds = np.minimum(varies / np.float32(finer * _PLAIN), np.float32(1)) ** _PLAINER
    return np.asarray(sure * odds / (1 - sure + sure * odds + np.float32(1e-9)), np.float32)


def as_often_right(sure: Float32Array) -> Float32Array:
    """Return probabilities of depth from motion alone, of the same shape, that are right as often as they say.

    Frames without a cue share more errors than those that a cue judges: rims of what is near, what reflects, the
    focal length.
    """
    against = _TOO_SURE * (1 - sure) / np.maximum(sure, np.float32(1e-6))
    return np.asarray(np.where(against < 1, 1 / (1 + against**_LESS_SURE / _TOO_SURE), sure), np.float32)


def _bend(log_depth: Float32Array) -> Float32Array:
    """Return by how much inverse depth departs from a plane between neighboring pixels, of itself, (h, w).

    The inverse depth of a plane is linear. A step between two surfaces that is spread over several pixels is not, at
    either end of it.
    """
    inverse = np.exp(-np.nan_to_num(log_depth, nan=0.0))
    padded = np.pad(inverse, 1, mode="reflect", reflect_type="odd")
    across = np.abs(padded[1:-1, 2:] + padded[1:-1, :-2] - 2 * inverse)
    down = np.abs(padded[2:, 1:-1] + padded[:-2, 1:-1] - 2 * inverse)
    return np.asarray(cv2.dilate(np.maximum(across, down) / inverse, _BESIDE_WINDOW), np.float32)


@dataclass
class ToldError:
    """Collects, frame by frame, what the mean error of static depth is told from."""

    from_motion: bool = False
    """The cue was interpolated between static points: as sure a pixel is farther off, and landmarks say nothing."""
    focal_depth_error: float = 0.0
    """Mean relative error that the cameras' focal lengths make, which all pixels and landmarks share."""
    pixels: FloatArray = field(default_factory=lambda: np.zeros(len(_BINS) + 1))
    """Number of static pixels by how sure they are."""
    expected: float = 0.0
    """Sum of the errors that go with these probabilities."""
    off: list[list[FloatArray]] = field(default_factory=lambda: [[] for _ in range(len(_BINS) + 1)])
    """By the same: ``|log depth - log z|`` at landmarks."""

    def add(
        self, log_depth: Float32Array, confidence: Float32Array, static: BoolArray, uv: FloatArray, log_z: FloatArray,
        *, common_sigma: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a frame.

        Args:
            log_depth: (h, w), NaN where missing.
            confidence: (h, w).
            static: (h, w) what is counted.
            uv: (N, 2) landmarks, working px.
            log_z: (N,) their log depth.
            common_sigma: Standard deviation of log depth that the frame shares with all others.
        """
        counted = static & np.isfinite(log_depth)
        sure = confidence[counted]
        above = [np.count_nonzero(sure >= np.float32(limit)) for limit in _BINS]
        self.pixels -= np.diff([len(sure), *above, 0])
        of_its_own = np.interp(sure, _SURENESS, _FROM_MOTION if self.from_motion else _ERRORS)
        self.expected += float(np.hypot(of_its_own, _SIGMA_TO_MEAN * common_sigma).sum())
        column, row = np.rint(uv).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < static.shape[1]) & (row < static.shape[0])
        inside[inside] = counted[row[inside], column[inside]]
        at = row[inside], column[inside]
        bins, off = np.digitize(confidence[at], _BINS), np.abs(log_depth[at] - log_z[inside])
        for number, found in enumerate(self.off):
            found.append(off[bins == number])

    def follow(self, other: ToldError) -> None:
        """Add what was collected of one frame after those that are here; frame by frame, sums have the same digits."""
        self.pixels += other.pixels
        self.expected += other.expected
        for mine, found in zip(self.off, other.off, strict=True):
            mine += found

    def mean(self) -> float | None:
        """Return the mean relative error to expect, scale apart; None if no pixel is static."""
        total = float(self.pixels.sum())
        if total == 0:
            return None
        prior = self.expected / total
        found = [np.concatenate(off) if off else np.zeros(0) for off in self.off]
        everywhere = np.concatenate(found)
        told = prior
        if not self.from_motion and len(everywhere) >= _MIN_COMPARED:
            typical = [float(np.median(off if len(off) >= _MIN_COMPARED else everywhere)) for off in found]
            at_landmarks = float(self.pixels @ np.array(typical)) / total
            told = prior**_PRIOR_SHARE * at_landmarks ** (1.0 - _PRIOR_SHARE)
        return float(np.hypot(told, self.focal_depth_error))
