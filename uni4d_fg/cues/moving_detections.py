"""From frames that are compared to what moves: a first look by and large, a second for where it ends, then colors."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.background_comparison import BackgroundComparison
from uni4d_fg.cues.detections import FrameDetections
from uni4d_fg.cues.evidence_over_time import LookedAt, averaged_over_time
from uni4d_fg.cues.frame_comparison import ComparedVideo
from uni4d_fg.cues.moving_regions import grown, moving_region, smoothed_evidence, trusted_components
from uni4d_fg.cues.neighbor_comparison import NeighborComparison
from uni4d_fg.cues.region_colors import NearRegion, color_odds
from uni4d_fg.frontend.sequence.bars import only_content

PackedMask = npt.NDArray[np.uint8]
"""A mask (h, w) at working size, packed by :func:`numpy.packbits`."""


def first_look(given: ComparedVideo, config: MotionMaskConfig, stop: Callable[[], bool]) -> Iterator[PackedMask]:
    """Yield by and large what moves, frame by frame.

    Raises:
        Cancelled: If ``stop`` turned true.
    """
    comparison = NeighborComparison(given, config)

    def moving(frame: int) -> PackedMask:
        evidence = _looked_at(comparison, config.smoothing_px, frame).evidence
        moves = _between_bars(_above_threshold(evidence, given, config), given)
        region = _trusted(moves, frame, given, config).any(axis=0)
        return np.packbits(cv2.resize(region.astype(np.uint8), comparison.size[::-1], interpolation=cv2.INTER_NEAREST))

    return comparison.of_frames(moving, stop)


def second_look(
    given: ComparedVideo, config: MotionMaskConfig, first: list[PackedMask], stop: Callable[[], bool]
) -> Iterator[NearRegion]:
    """Yield the regions that move, and what is around them, frame by frame, from what the first look found in T frames.

    Raises:
        Cancelled: If ``stop`` turned true.
    """
    comparison = BackgroundComparison(given, config, first)
    pictured = _between_bars(np.ones(given.video.image_size, bool), given)
    pictured = cv2.resize(pictured.astype(np.uint8), comparison.size[::-1], interpolation=cv2.INTER_NEAREST) > 0
    looked = comparison.of_frames(partial(_looked_at, comparison, config.background_smoothing_px), stop)
    for frame, (image, evidence, _) in enumerate(averaged_over_time(looked, config)):
        region = np.asarray(_trusted(_above_threshold(evidence, given, config), frame, given, config).any(axis=0))
        yield NearRegion.of(region, image, evidence, config.color_reach_px, pictured)


def detections(
    given: ComparedVideo, config: MotionMaskConfig, second: list[NearRegion]
) -> Generator[FrameDetections, None, None]:
    """Yield what moves, frame by frame: where the second look found regions, by what was seen and by color."""
    odds = color_odds(second, config)
    for frame, looked in enumerate(second):
        moves = moving_region(looked.moving(odds), given.video.image_size, config.threshold, config)
        masks = grown(_trusted(_between_bars(moves, given), frame, given, config), config.grow_px)
        yield FrameDetections(masks, np.ones(len(masks), np.int32), np.ones(len(masks), np.float32))


def _looked_at(comparison: NeighborComparison | BackgroundComparison, radius_px: float, frame: int) -> LookedAt:
    """Return what a comparison says of a frame, shared among like colors within a radius, image px; on any thread."""
    log_odds, weight = comparison.evidence(frame)
    image = comparison.frames[frame].image
    radius = radius_px * float(comparison.scale[0])
    return LookedAt(image, smoothed_evidence(log_odds, image, radius, comparison.config), weight)


def _above_threshold(smooth: Float32Array, given: ComparedVideo, config: MotionMaskConfig) -> BoolArray:
    return moving_region(smooth, given.video.image_size, given.threshold(config), config)


def _between_bars(region: BoolArray, given: ComparedVideo) -> BoolArray:
    """Return what of a region (H, W) is no black bar: bars seem to move where the scene does."""
    content = given.video.content
    return region if content is None else only_content(region, content, 0)


def _trusted(region: BoolArray, frame: int, given: ComparedVideo, config: MotionMaskConfig) -> BoolArray:
    return trusted_components(region, given.tracks, given.motion, frame, config)
