"""Configuration of loop closing."""

from __future__ import annotations

from typing import Literal

from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.solver import NativeKernelConfig


class LoopsConfig(Section):
    """Places that come into sight again after they were out of sight, as relative poses in bundle adjustment.

    A stream looks for them at its end, and closes them on a graph of its poses.
    """

    enabled: Literal["auto", "off"] = setting(
        "auto",
        "'auto' looks for them where the cameras, as solved so far, lost a place from sight and may have come back; "
        "needs energy 'map' and solver 'lm'. 'off' never looks.",
    )
    interval: int = setting(5, "Every so many frames one is compared with earlier ones.", ge=1)
    min_gap: int = setting(60, "Frames that lie between two that are compared, at least.", ge=2)
    out_of_sight: float = setting(
        0.1, "A place is out of sight in a frame that has less than this part of its points in the image.", gt=0, lt=1
    )
    features: int = setting(400, "SIFT features of a frame.", ge=50)
    words: int = setting(32, "Words of the vocabulary, which is made of the video's own features.", ge=4)
    candidates: int = setting(
        3, "Earlier frames that are compared in detail with each, those that look most alike.", ge=1
    )
    match_ratio: float = setting(
        0.8, "A match counts if the second best is farther than it by the inverse of this.", gt=0, lt=1
    )
    max_error_px: float = setting(
        3.0, "Largest reprojection error of a match, px of an image that is 640 px wide; at least 1 px.", gt=0
    )
    min_inliers: int = setting(20, "Matches that a relative pose needs.", ge=6)
    min_inlier_part: float = setting(0.4, "And their part of all matches.", gt=0, lt=1)
    min_cells: int = setting(6, "Cells of a 4 x 4 grid that they are spread over, in both images.", ge=1, le=16)
    support: int = setting(
        2, "Neighboring pairs of frames that must say the same, by the motion in between as solved so far.", ge=0
    )
    max_disagreement_rad: float = setting(0.03, "What 'the same' allows in rotation, rad.", gt=0)
    max_disagreement_depth: float = setting(0.03, "And in translation, as a part of the median depth.", gt=0)
    max_drift: float = setting(
        0.15,
        "A closure that moves one camera against the other by more than this part of the way between them, or turns it "
        "by more than this part of the turns, is taken for a place that only looks alike.",
        gt=0,
    )
    kernel: NativeKernelConfig = setting(
        NativeKernelConfig(kind="cauchy", threshold=2.4), "Robust kernel of a closure."
    )
    let_go: float = setting(
        10.0,
        "A closure that bundle adjustment left so many of its sigmas away is let go for good when it is solved again.",
        gt=0,
    )
