"""Configuration of the synthetic sequence."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import model_validator

from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.cue_noise import CueNoise

PathKind: TypeAlias = Literal["handheld", "static", "rotation", "forward"]
ObjectChoice: TypeAlias = Literal["none", "rigid", "deforming", "both", "all_dynamic"]

MAX_OBJECTS_PER_KIND = 3
"""Most rigid (and most deforming) objects that the room of the scene has a place for."""


class SyntheticSceneConfig(Section):
    """Everything a synthetic sequence depends on; the same values give the same arrays."""

    num_frames: int = setting(30, "Number of frames T.", ge=1)
    height: int = setting(240, "Image height, px.", ge=16)
    width: int = setting(320, "Image width, px.", ge=16)
    focal: float = setting(300.0, "True focal length of both axes, px.", gt=0)
    camera_model: Literal["PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"] = setting(
        "PINHOLE", "Camera model, by COLMAP's names."
    )
    distortion: tuple[float, ...] = setting((), "Distortion parameters of the camera model.")
    frame_rate: float = setting(15.0, "Frames per second: a higher rate means less motion per frame, Hz.", gt=0)
    path: PathKind = setting("handheld", "Camera trajectory: 'handheld', 'static', 'rotation' or 'forward'.")
    camera_speed: float = setting(0.42, "Speed of the camera along its path, m/s.", ge=0, le=10)
    objects: ObjectChoice = setting(
        "both",
        "What moves: 'none', 'rigid', 'deforming', 'both', or 'all_dynamic' (both, and the room itself).",
    )
    objects_per_kind: int = setting(1, "Number of rigid and of deforming objects.", ge=1, le=MAX_OBJECTS_PER_KIND)
    object_scale: float = setting(
        1.0, "Size of the objects, of the usual one: the share of the image that moves.", ge=0.2, le=4
    )
    grid_columns: int = setting(32, "Query points per row of the grid.", ge=2)
    grid_rows: int = setting(24, "Query points per column of the grid.", ge=2)
    query_interval: int = setting(10, "A new grid of tracks is started every this many frames.", ge=1)
    margin_px: float = setting(6.0, "Distance of the outermost query points from the image border, px.", ge=0)
    render_images: bool = setting(True, "Shade the images; otherwise they are flat gray and nothing is spent.")
    noise: CueNoise = setting(CueNoise(), "Noise of the cues.")
    seed: int = setting(0, "Seed of the noise.", ge=0)

    @model_validator(mode="after")
    def _margin_fits(self) -> SyntheticSceneConfig:
        if 2 * self.margin_px >= min(self.height, self.width) - 1:
            raise ValueError(f"margin_px {self.margin_px:g} leaves nothing of {self.width} x {self.height} px")
        return self
