"""Configuration of depth from several views."""

from __future__ import annotations

from uni4d_fg.config.base import Section, setting


class MultiviewConfig(Section):
    """Depth of the static scene by matching frames, with the solved cameras."""

    enabled: bool = setting(True, "Match frames; otherwise dense depth is the corrected cue alone.")
    longer_side_px: int = setting(
        448, "Frames are matched at half their size, with a longer side of at most this, px, ...", ge=32
    )
    least_side_px: int = setting(320, "... and of at least this, where they are that large.", ge=32)
    views: int = setting(4, "Frames that a frame is matched with, at most.", ge=1, le=16)
    reach: int = setting(
        16,
        "They are at most this many frames away, four times as many where too few of these have parallax.",
        ge=1,
    )
    min_overlap: float = setting(0.5, "A view sees at least this part of the frame's landmarks.", ge=0, le=1)
    min_angle_deg: float = setting(
        0.4, "Views whose rays to the frame's landmarks meet at less than this (median) are left out, degrees.", gt=0
    )
    wanted_angle_deg: float = setting(
        3.0, "The best angle: more shows depth better but looks less alike, degrees.", gt=0
    )
    min_points: int = setting(20, "A frame that sees fewer landmarks is not matched.", ge=4)
    min_planes: int = setting(32, "Planes of inverse depth, at least ...", ge=8, le=256)
    max_planes: int = setting(64, "... and at most.", ge=8, le=256)
    plane_step_px: float = setting(0.6, "Two planes are this far apart in the view that moves most, px.", gt=0)
    range_margin: float = setting(
        0.35, "The planes reach this part of the landmarks' range of inverse depth beyond it, on both sides.", ge=0
    )
    window_radius_px: int = setting(2, "Half side of the window that is compared, px at the working size.", ge=1, le=7)
    image_noise: float = setting(
        0.01, "Standard deviation of the noise of gray values, of 1: weaker texture says nothing.", gt=0, lt=1
    )
    difference_share: float = setting(
        0.4,
        "Part of the cost that differences of gray values are, beside the correlation: they keep edges.",
        ge=0,
        le=1,
    )
    largest_difference: float = setting(0.1, "Larger differences of gray values, of 1, are all alike.", gt=0, le=1)
    small_step_penalty: int = setting(
        30, "Cost (of 255) of a neighbor that is one plane away, where the image is flat.", ge=0, le=255
    )
    large_step_penalty: int = setting(100, "Cost of one that is farther away, alike.", ge=0, le=1000)
    edge_contrast: float = setting(0.03, "A difference between gray values, of 1, that halves these costs.", gt=0)
    mask_band_px: int = setting(
        3, "Width of the band around masks that is taken to move as they are, working px.", ge=0
    )
    compared_offsets: tuple[int, ...] = setting(
        (2, 5), "Depth of a frame is compared with that of the frames this far before and after."
    )
    max_disagreement: float = setting(
        0.03, "Depth of two frames agrees if it differs by less than this part.", gt=0, lt=1
    )
    edge_offsets: tuple[int, ...] = setting(
        (4, 8, 12), "Edges of depth are looked for again in the frames this far before and after; none: they stay."
    )
