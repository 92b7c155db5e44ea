"""Configuration of the search for fragments of tracks that belong to one static point."""

from __future__ import annotations

from typing import Literal

from uni4d_fg.config.base import Section, setting


class RejoinConfig(Section):
    """Static tracks that ended (occlusion, blur, a look away) and were started anew at the same point."""

    enabled: Literal["auto", "on", "off"] = setting(
        "auto",
        "Join fragments between the two solves of bundle adjustment, so that the second one has one landmark for each "
        "point; 'auto' where many tracks were cut. One graph with energy 'map' and measured noise only; not in windows "
        "and streams.",
    )
    auto_part: float = setting(
        0.15, "'auto' joins if this part of the landmarks may be a fragment by their positions.", gt=0, lt=1
    )
    max_distance_px: float = setting(
        3.0, "Landmarks farther apart than this in the frame where the later track starts are not compared, px.", gt=0
    )
    max_sigmas: float = setting(3.5, "Nor those that differ by more than this many sigmas of their positions.", gt=0)
    camera_sigma_px: float = setting(0.3, "What the cameras of the two fragments may add to those sigmas, px.", ge=0)
    patch_px: int = setting(11, "Side of the compared patches, px.", ge=5, le=61)
    views: int = setting(3, "Views of each fragment that are compared, the best pair counts.", ge=1, le=8)
    min_correlation: float = setting(0.8, "Normalized correlation that the patches need.", gt=0, lt=1)
    max_offset_px: float = setting(
        1.0, "Largest distance between the landmarks' projection and the best match of the patches, px.", gt=0, le=2
    )
    min_probability: float = setting(
        0.7, "Probability that a pair needs against all others of its two tracks.", ge=0.5, lt=1
    )
    min_contrast: float = setting(
        3.0, "Standard deviation of gray levels that a patch needs to be told from others.", ge=0
    )
