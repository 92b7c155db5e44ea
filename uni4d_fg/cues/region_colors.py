"""What colors say of what moves, learned from the whole video.

What evidence says of a pixel is blurred, and silent where the image is flat or a thing stands for a moment: heads and
legs are missed, and strips of the background beside a thing are taken along. But what is missed in one frame is seen
to move in others, and has the same color there. Near the regions that move, by and large, two histograms of color are
counted over all frames: of the pixels that move for sure, and of those that stand still for sure. The log of the ratio
of both is one more evidence, with which they are counted a second time: what evidence took for the wrong side of an
edge is mostly put right by then.

Histograms of color as a model of what moves and of what does not are those of Boykov and Jolly (ICCV 2001); that they
are counted again with what they say is hard expectation maximization.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.moving_regions import disk
from uni4d_fg.cues.packed_mask import PackedMask

_BINS = 32
"""Of lightness and of both axes of color (CIE L*a*b*)."""
_COLORFUL = 80
"""Most of a* and b*: what is more colorful has the last bin."""
_SMOOTHED = 0.5
"""Standard deviation of the Gaussian over the histograms, bins."""
_RARE = 2e-5
"""Added to both shares of a color: one that either has less of says nothing. Of few pixels one more is added, so that
the color of a single one doubles its odds at most."""
_ROUNDS = 2
_BLUR_PX = 1.0
"""Standard deviation of the Gaussian over what colors say, working px: that of the compression and of mixed pixels."""
_STEPS, _MOST = 24, 127
"""Evidence is held in steps of one over this, log odds, and so many of them at most: a signed byte."""


@dataclass(frozen=True)
class NearRegion:
    """What a frame shows in and around its regions: little enough that it is held of all frames."""

    near: PackedMask
    """Which pixels (h, w) at working size that is."""
    color: npt.NDArray[np.uint16]
    """(N,) bins of their colors ..."""
    held: npt.NDArray[np.int8]
    """... and the log odds that they move."""

    @classmethod
    def of(
        cls, region: BoolArray, image: ImageArray, evidence: Float32Array, reach_px: int, pictured: BoolArray
    ) -> NearRegion:
        """Keep what is not farther than ``reach_px`` (working px) from a region.

        Args:
            region: (H, W) True where something moves, by and large.
            image: (h, w, 3) uint8 RGB at working size.
            evidence: (h, w) log odds that pixels move.
            reach_px: How far.
            pictured: (h, w) what is no black bar.
        """
        size = evidence.shape[:2]
        small = cv2.resize(region.astype(np.uint8), size[::-1], interpolation=cv2.INTER_AREA)
        near = (cv2.dilate(small, disk(reach_px)) > 0) & pictured
        held = np.clip(np.rint(evidence[near] * _STEPS), -_MOST, _MOST).astype(np.int8)
        return cls(PackedMask.of(near), _bins(cv2.cvtColor(image, cv2.COLOR_RGB2LAB)[near]), held)

    @property
    def evidence(self) -> Float32Array:
        """Return the log odds (N,) that the pixels near move, by what was seen of them."""
        return np.multiply(self.held, np.float32(1 / _STEPS), dtype=np.float32)

    def colored(self, odds: Float32Array) -> tuple[BoolArray, Float32Array]:
        """Return which pixels (h, w) are near, and the log odds (N,) that they move by what was seen and by color."""
        mask, said = self.near.unpacked(), np.zeros(self.near.size, np.float32)
        said[mask] = odds[self.color]
        return mask, self.evidence + cv2.GaussianBlur(said, (0, 0), _BLUR_PX)[mask]

    def moving(self, odds: Float32Array) -> Float32Array:
        """Return the log odds (h, w) that pixels move; those that are not near do not."""
        mask, evidence = self.colored(odds)
        out = np.full(self.near.size, np.float32(-_MOST / _STEPS))
        out[mask] = evidence
        return out


def color_odds(frames: Sequence[NearRegion], config: MotionMaskConfig) -> Float32Array:
    """Return the log odds that a color moves, by its bin; 0 where too little is known.

    Args:
        frames: Of the whole video.
        config: Its fields ``color_...``.
    """
    odds = np.zeros(_BINS**3, np.float32)
    for turn in range(_ROUNDS):
        moving, static = np.zeros(_BINS**3), np.zeros(_BINS**3)
        for frame in frames:
            evidence = frame.evidence if turn == 0 else frame.colored(odds)[1]
            moving += np.bincount(frame.color[evidence > config.color_moving], minlength=_BINS**3)
            static += np.bincount(frame.color[evidence < config.color_static], minlength=_BINS**3)
        fewest = min(moving.sum(), static.sum())
        if fewest == 0:
            break
        rare = _RARE + 1.0 / fewest
        ratio = np.log((_shares(moving) + rare) / (_shares(static) + rare))
        odds = np.clip(ratio, -config.color_limit, config.color_limit).astype(np.float32)
    return odds


def _bins(lab: np.ndarray) -> npt.NDArray[np.uint16]:
    """Return the bin (N,) of each color (N, 3) uint8 L*a*b*."""
    of_value = np.arange(256)
    lightness = (of_value * _BINS // 256).astype(np.uint16)
    # OpenCV has a* and b* of bytes shifted by 128.
    color = np.clip((of_value - 128 + _COLORFUL) * _BINS // (2 * _COLORFUL), 0, _BINS - 1).astype(np.uint16)
    bins: npt.NDArray[np.uint16] = (lightness[lab[:, 0]] * _BINS + color[lab[:, 1]]) * _BINS + color[lab[:, 2]]
    return bins


def _shares(count: FloatArray) -> FloatArray:
    """Return which part of all pixels has each color, smoothed over those alike."""
    smooth = gaussian_filter(count.reshape((_BINS,) * 3), _SMOOTHED).reshape(-1)
    return np.asarray(smooth / smooth.sum())
