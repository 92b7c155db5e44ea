"""From frames that are compared to what moves: a first look by and large, a second for where it ends, then colors."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from functools import partial

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.background_comparison import BackgroundComparison
from uni4d_fg.cues.detections import FrameDetections
from uni4d_fg.cues.evidence_over_time import LookedAt, averaged_over_time
from uni4d_fg.cues.frame_comparison import ComparedVideo
from uni4d_fg.cues.moving_regions import grown, moving_region, smoothed_evidence, trusted_components
from uni4d_fg.cues.neighbor_comparison import NeighborComparison
from uni4d_fg.cues.packed_mask import PackedMask
from uni4d_fg.cues.region_colors import NearRegion, color_odds
from uni4d_fg.frontend.sequence.bars import only_content


def first_look(given: ComparedVideo, config: MotionMaskConfig, stop: Callable[[], bool]) -> Iterator[PackedMask]:
    """Yield by and large what moves, frame by frame.

    Raises:
        Cancelled: If ``stop`` turned true.
    """
    comparison = NeighborComparison(given, config)

    def moving(frame: int) -> PackedMask:
        evidence = _looked_at(comparison, config.smoothing_px, frame).evidence
        region = _regions(evidence, given.threshold(config), frame, given, config).any(axis=0)
        small = cv2.resize(region.astype(np.uint8), comparison.size[::-1], interpolation=cv2.INTER_NEAREST)
        return PackedMask.of(small > 0)

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
        region = _regions(evidence, given.threshold(config), frame, given, config).any(axis=0)
        yield NearRegion.of(np.asarray(region), image, evidence, config.color_reach_px, pictured)


def detections(
    given: ComparedVideo, config: MotionMaskConfig, second: list[NearRegion]
) -> Generator[FrameDetections, None, None]:
    """Yield what moves, frame by frame: where the second look found regions, by what was seen and by color."""
    odds = color_odds(second, config)
    for frame, looked in enumerate(second):
        masks = grown(_regions(looked.moving(odds), config.threshold, frame, given, config), config.grow_px)
        yield FrameDetections(masks, np.ones(len(masks), np.int32), np.ones(len(masks), np.float32))


def _looked_at(comparison: NeighborComparison | BackgroundComparison, radius_px: float, frame: int) -> LookedAt:
    """Return what a comparison says of a frame, shared among like colors within a radius, image px; on any thread."""
    log_odds, weight = comparison.evidence(frame)
    image = comparison.frames[frame].image
    radius = radius_px * float(comparison.scale[0])
    return LookedAt(image, smoothed_evidence(log_odds, image, radius, comparison.config), weight)


def _regions(
    evidence: Float32Array, threshold: float, frame: int, given: ComparedVideo, config: MotionMaskConfig
) -> BoolArray:
    """Return the regions (N, H, W) where evidence (h, w) exceeds a threshold, between black bars, that are trusted."""
    region = _between_bars(moving_region(evidence, given.video.image_size, threshold, config), given)
    return trusted_components(region, given.tracks, given.motion, frame, config)


def _between_bars(region: BoolArray, given: ComparedVideo) -> BoolArray:
    """Return what of a region (H, W) is no black bar: bars seem to move where the scene does."""
    content = given.video.content
    return region if content is None else only_content(region, content, 0)
