"""Configuration of the search for shot changes."""

from __future__ import annotations

from typing import Literal

from uni4d_fg.config.base import Section, setting


class ShotsConfig(Section):
    """Cuts of an edited video; each shot becomes a reconstruction of its own."""

    split: Literal["auto", "off"] = setting(
        "auto", "'auto' looks for cuts and reconstructs each shot on its own; 'off' does not look.", basic=True
    )
    min_frames: int = setting(6, "Shots with fewer frames are left out, with a warning.", ge=2, basic=True)
    width: int = setting(160, "Longer side of the images in which cuts are looked for, px.", ge=64, le=640)
    confirming_width: int = setting(
        320, "Longer side of the images in which a cut must be found, too, px.", ge=64, le=1280
    )
    max_corners: int = setting(90, "Corners of a frame that are looked for in another, at most.", ge=20)
    min_corners: int = setting(12, "A frame with fewer corners shows nothing: black, white or out of focus.", ge=4)
    min_contrast: float = setting(2.0, "Standard deviation of the gray values of a frame that shows something.", ge=0)
    patch_px: int = setting(11, "Side of the patch around a corner that must look the same, px.", ge=5, le=31)
    min_similarity: float = setting(0.75, "Correlation of such a patch with the other frame's.", gt=0, lt=1)
    forward_backward_px: float = setting(1.0, "A corner followed there and back misses by no more than this, px.", gt=0)
    max_broken: float = setting(
        0.30, "Frames are not connected where less than this part of the corners is found again.", gt=0, lt=1
    )
    min_overlap: float = setting(0.3, "Part of the image that two frames of a fast pan share, at least.", gt=0, lt=1)
    pan_similarity: float = setting(
        0.65, "Correlation of the whole overlap at which two frames are connected by a pan.", gt=0, lt=1
    )
    look_around: int = setting(4, "Frames before and after a suspected cut; a flash lasts no longer.", ge=1, le=30)
    dissolve_spans: tuple[int, ...] = setting((10, 18, 28), "Frames across which dissolves are looked for.")
    max_surviving: float = setting(
        0.12, "Part of the corners that outlives the shortest span across a dissolve, at most.", gt=0, lt=1
    )
    min_lasting_similarity: float = setting(
        0.6, "Correlation of a patch with what it was at the beginning of such a span.", gt=0, lt=1
    )
    sure_blend: float = setting(
        0.95,
        "Part of the variance that a blend explains, from which twice as many corners may outlive a dissolve.",
        gt=0,
        le=1,
    )
    min_explained: float = setting(
        0.4,
        "Part of the variance of its frames that a dissolve explains as a blend of both sides, over the shortest span; "
        "over longer ones less, in the same proportion.",
        ge=0,
        le=1,
    )
    min_blend_gain: float = setting(
        0.14,
        "Part of the variance of a frame of a dissolve that both shots explain beyond what one does, at least.",
        ge=0,
        lt=1,
    )
    max_motion: float = setting(
        0.1, "Motion from frame to frame, part of the image, within which dissolves are looked for.", gt=0, lt=1
    )
