"""Configuration of what happens before the first stage: tracks, labels, use of given poses."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from uni4d_fg.config.base import Section, setting


class TrackingConfig(Section):
    """Built-in tracker (pyramidal Lucas-Kanade on a grid), used when a sequence brings no tracks."""

    grid_columns: int = setting(50, "Query points per row of the grid.", ge=2, le=400, basic=True)
    grid_rows: int = setting(50, "Query points per column of the grid.", ge=2, le=400, basic=True)
    query_interval: int = setting(10, "A new grid is started every this many frames.", ge=1, basic=True)
    reseed_spacing: float | None = setting(
        1.25,
        "Side of the cells, in spacings of the grid, in which a point is started in any frame between two grids that "
        "leaves them without a live one; null: points start on the grids only.",
        ge=1,
        basic=True,
    )
    reseed_quality: float = setting(
        0.03, "Texture that such a point needs, as a fraction of the best in the image.", ge=0, lt=1
    )
    margin_px: float = setting(8.0, "Distance of the outermost query points from the image border, px.", ge=0)
    window_px: int = setting(21, "Side of the Lucas-Kanade window, px.", ge=5, le=101)
    pyramid_levels: int = setting(3, "Pyramid levels above the full image.", ge=0, le=8)
    max_iterations: int = setting(30, "Lucas-Kanade iterations per level.", ge=1)
    convergence_px: float = setting(0.01, "Lucas-Kanade stops when a point moves less than this, px.", gt=0)
    forward_backward_px: float = setting(0.5, "Largest allowed forward-backward distance, px.", gt=0, basic=True)
    refine: Literal["auto", "on", "off"] = setting(
        "auto",
        "Find each point's first view, affinely warped, in every image, so that errors of the steps do not add up. "
        "'auto': with the C++ extension, as NumPy takes ten times as long; 'off': steps alone, each checked forwards "
        "and backwards.",
    )
    refine_every: int = setting(
        3,
        "Steps from one search for a point's first view to the next; those between are checked forwards and backwards.",
        ge=1,
    )
    patch_px: int = setting(15, "Side of the first view that is found again, px; made odd.", ge=5, le=61)
    min_patch_correlation: float = setting(
        0.8, "Correlation with its first view below which a point takes a new one where it is.", gt=0, lt=1
    )
    max_refinement_px: float = setting(
        0.5, "The same if the first view is found farther than this from where the step leads, px.", gt=0
    )
    match_blur: bool = setting(
        True,
        "Where the camera turns so fast that an image is blurred along its motion, make first views as blurred before "
        "they are looked for in it.",
    )
    bridge_frames: int | None = setting(
        None,
        "Points that something hides together with those around them are looked for again behind it, for this many "
        "frames, and keep their tracks: 25 bridges an occlusion of 15. 0: what is lost stays lost. null: 25 in a video "
        "in which something sweeps over the picture, so that hardly any track outlives it; else 0.",
        ge=0,
    )
    max_drift_px: float | None = setting(
        None,
        "Largest distance between a point and where its first appearance is found, px; null: not checked. The check "
        "removes drifted observations, and with them some that hold the cameras.",
        gt=0,
    )
    max_patch_error: float = setting(12.0, "Largest mean absolute gray-level difference of the window.", gt=0)
    min_texture: float = setting(1e-4, "Smallest eigenvalue of the window's gradient matrix (OpenCV scale).", ge=0)
    border_px: float = setting(1.0, "A point closer than this to the image border is lost, px.", ge=0)
    min_observations: int = setting(3, "Tracks seen in fewer frames are not kept.", ge=1)


class LabelConfig(Section):
    """Static / dynamic / rejected labels from the masks, with an uncertain band around object borders."""

    band_static_px: int = setting(
        5, "Width of the band on the static side of a mask border, px.", ge=0, le=100, basic=True
    )
    band_dynamic_px: int = setting(
        3, "Width of the band on the object's side of a mask border, px.", ge=0, le=100, basic=True
    )
    band_weight: float = setting(
        0.0, "Weight of a kept track's observations inside the band; 0 drops them.", ge=0, le=1
    )
    min_static_frames: int = setting(
        5, "A static track must be surely seen in this many frames to carry a camera.", ge=1, basic=True
    )
    min_static_fraction: float = setting(
        0.5, "The same as a fraction of the frames, taken where that is fewer (a short video).", ge=0, le=1
    )
    max_off_label_fraction: float = setting(
        0.0, "Share of a track's sure observations that may disagree with its label (they are dropped).",
        ge=0, lt=0.5,
    )  # fmt: skip
    max_depth_spread: float = setting(
        0.05, "Depth is interpolated only between pixels that differ by less than this fraction.", ge=0
    )


class InputConfig(Section):
    """What of the sequence is taken as known."""

    intrinsics: Literal["free", "fixed"] = setting(
        "free", "'free': the sequence's intrinsics are a starting value; 'fixed': they are kept.", basic=True
    )
    poses: Literal["estimate", "initial", "fixed"] = setting(
        "estimate",
        "'estimate': ignore given poses; 'initial': start stage 2 from them; 'fixed': keep them.",
        basic=True,
    )
    black_bars: Literal["auto", "keep"] = setting(
        "auto", "'auto' finds black bars beside the pictures and leaves them out; 'keep' takes them for content."
    )
    repeated_frames: Literal["auto", "keep"] = setting(
        "auto",
        "'auto' finds frames that repeat the one before, which a change of frame rate leaves, and gives them its pose; "
        "'keep' solves them as frames of their own.",
    )
    repair_masks: bool = setting(
        True,
        "Make masks that are missing for a frame or two, between frames that have them, from those beside by optical "
        "flow, and average masks that grow and shrink from frame to frame.",
    )
    min_depth_m: float = setting(0.05, "Depth below this is treated as missing, m.", ge=0, basic=True)
    max_depth_m: float = setting(80.0, "Depth above this is treated as missing, m.", gt=0, basic=True)

    @model_validator(mode="after")
    def _some_depth_is_usable(self) -> InputConfig:
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(
                f"min_depth_m ({self.min_depth_m:g}) must be below max_depth_m ({self.max_depth_m:g}): all depth would "
                "be missing"
            )
        return self
