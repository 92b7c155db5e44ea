"""The first look: every frame compared with a few before and after it, while nothing is known of what moves.

Of the two directions in time the less suspicious one counts: what is hidden in one is mostly seen in the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, ImageArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.appearance import FrameAppearance, frame_appearance, moved_evidence, with_other_depth
from uni4d_fg.cues.behind_moving import depth_behind
from uni4d_fg.cues.frame_comparison import ComparedVideo, Evidence, FrameComparison
from uni4d_fg.cues.moving_regions import disk


@dataclass(frozen=True)
class NeighborFrame:
    """A frame at working size, (h, w)."""

    image: ImageArray
    tracks: Float32Array
    """What its tracks say, from -1 (static) to 1 (moving)."""
    appearance: FrameAppearance
    """With the depth that there is."""
    behind: FrameAppearance
    """With that of the scene around where most tracks move."""


class NeighborComparison(FrameComparison[NeighborFrame]):
    """Frames compared with those at ``config.baselines`` before and after."""

    def __init__(self, given: ComparedVideo, config: MotionMaskConfig) -> None:
        super().__init__(given, config, config.baselines)

    def prepared(self, frame: int) -> NeighborFrame:
        """Prepare image and depth, and depth of the scene around where most tracks move."""
        image, depth, settings = self.image(frame), self.depth(frame), self.appearance_settings(frame)
        tracks = self.track_evidence(frame)
        appearance = behind = frame_appearance(image, depth, *settings)
        if self.given.is_interpolated and (tracks > 0).any():
            moving = cv2.dilate((tracks > 0).astype(np.uint8), disk(self.config.behind_reach_px)) > 0
            behind = with_other_depth(appearance, depth_behind(depth, moving), *settings)
        return NeighborFrame(image, tracks, appearance, behind)

    def evidence(self, frame: int) -> Evidence:
        """Add up the baselines and what the tracks say."""
        total, count = np.zeros(self.size, np.float32), 0
        for number, sides in enumerate(self.others(frame)):
            if sides:
                total += np.minimum.reduce([self._compared(frame, other, bool(number % 2)) for other in sides])
                count += 1
        if count:
            total *= len(self.baselines) / count
        total += np.float32(self.config.track_weight) * self.frames[frame].tracks
        return Evidence(total, np.ones_like(total))

    def _compared(self, frame: int, other: int, as_given: bool) -> Float32Array:
        """Compare two frames; both hypotheses of what is still have their say, at every second baseline each."""
        source, target = self.frames[frame], self.frames[other]
        ours, theirs = (source.appearance, target.appearance) if as_given else (source.behind, target.behind)
        return moved_evidence(ours, theirs.compared, self.predicted(ours.z, (frame, other)), self.config)
