"""The second look: every frame compared with the background alone, as frames farther away show it.

The first look (:mod:`uni4d_fg.cues.neighbor_comparison`) knows by and large what moves where. Away from there every
frame shows background, so that a pixel that differs from what many of them show moves; and one that looks like them is
background even where the image is flat, unless the thing before it has the same color. The first look cannot tell: a
plain thing that moves by less than its size looks as if it stood. Nor can it tell shadows, which move as well: before
the background they are the background, darker.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain

import cv2
import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, ImageArray
from uni4d_fg.config.motion_masks import MotionMaskConfig
from uni4d_fg.cues.appearance import ComparedFrame, FrameAppearance, compared_frame, frame_appearance, moved_evidence
from uni4d_fg.cues.behind_moving import depth_behind
from uni4d_fg.cues.frame_comparison import ComparedVideo, Evidence, FrameComparison
from uni4d_fg.cues.moving_regions import disk
from uni4d_fg.cues.packed_mask import PackedMask

_AS_FIRST = 0.75
"""Log odds above the threshold, or below it, by what the first look said, where no frame shows the background."""
_ASSUMED = 0.3
"""Weight of that beside what frames show of the same surface at other times."""
_OF_ALL = 3.0
"""Times the mean over frames, in which what one frame says is shared by others."""


@dataclass(frozen=True)
class BackgroundFrame:
    """A frame at working size, (h, w): little enough that many are held."""

    image: ImageArray
    depth: Float32Array
    """Of the background, in the unit of the maps."""
    may_move: BoolArray
    """What is not background, with a margin."""
    compared: ComparedFrame


class BackgroundComparison(FrameComparison[BackgroundFrame]):
    """Frames compared with the background of those at ``config.background_baselines`` before and after.

    Args:
        given: The video.
        config: Baselines and weights.
        first_look: T masks (h, w) at working size of what moves by and large.
    """

    def __init__(self, given: ComparedVideo, config: MotionMaskConfig, first_look: list[PackedMask]) -> None:
        super().__init__(given, config, config.background_baselines)
        self._first_look = first_look
        self._threshold = given.threshold(config)

    def prepared(self, frame: int) -> BackgroundFrame:
        """Prepare a frame to be compared with."""
        image = self.image(frame)
        margin = disk(self.config.background_margin_px)
        may_move = np.asarray(cv2.dilate(self._first_look[frame].unpacked().astype(np.uint8), margin) > 0)
        # Depth of what moves reaches beyond what was found of it.
        around = cv2.dilate(may_move.astype(np.uint8), disk(self.config.behind_reach_px)) > 0
        depth = depth_behind(self.depth(frame), np.asarray(around))
        return BackgroundFrame(image, depth, may_move, compared_frame(image, depth, *self.appearance_settings(frame)))

    def evidence(self, frame: int) -> Evidence:
        """Take the mean over the frames that show the background, and what the first look said where none does.

        The color before a background may be any: where the image is flat it differs as it would elsewhere.
        """
        given = self.frames[frame]
        source = frame_appearance(given.image, given.depth, *self.appearance_settings(frame))
        texture, least = source.contrast, np.float32(3 * self.config.background_contrast**2)
        source = replace(source, contrast=np.maximum(texture, least))
        total, count = np.zeros(self.size, np.float32), np.zeros(self.size, np.float32)
        for other in chain.from_iterable(self.others(frame)):
            said = self._compared(source, texture, frame, other)
            shown = np.isfinite(said)
            total[shown] += said[shown]
            count += shown
        at_first = self._threshold + np.where(self._first_look[frame].unpacked(), _AS_FIRST, -_AS_FIRST)
        mean = np.where(count > 0, np.float32(_OF_ALL) * total / np.maximum(count, 1), at_first)
        log_odds = mean + np.float32(self.config.background_track_weight) * self.track_evidence(frame)
        return Evidence(log_odds.astype(np.float32), np.where(count > 0, 1, _ASSUMED).astype(np.float32))

    def _compared(self, source: FrameAppearance, texture: Float32Array, frame: int, other: int) -> Float32Array:
        """Compare a frame with what another shows of the background; NaN (h, w) where it shows none."""
        target = self.frames[other]
        static = self.predicted(source.z, (frame, other))
        evidence = moved_evidence(source, target.compared, static, self.config, texture)
        u, v = np.asarray(static.u, np.float32), np.asarray(static.v, np.float32)
        covered = cv2.remap(
            target.may_move.astype(np.uint8), u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(1,)
        )
        # What is outside of the other frame, or hidden in it, has no evidence at all.
        return np.where((covered > 0) | (evidence == 0), np.float32(np.nan), evidence)
