"""How noisy the cues of a synthetic sequence are."""

from __future__ import annotations

from pydantic import model_validator

from uni4d_fg.config.base import Section, setting


class CueNoise(Section):
    """Noise of the cues; every field at zero leaves the cues exact."""

    track_sigma_px: float = setting(0.5, "Standard deviation of each track coordinate, px.", ge=0, le=20)
    outlier_fraction: float = setting(0.02, "Part of the visible observations that are displaced.", ge=0, le=1)
    outlier_min_px: float = setting(4.0, "Smallest displacement of an outlier, px.", ge=0, le=100)
    outlier_max_px: float = setting(20.0, "Largest displacement of an outlier, px.", ge=0, le=200)
    visibility_drop_fraction: float = setting(0.05, "Part of the visible observations that are lost.", ge=0, le=1)
    false_visibility_fraction: float = setting(
        0.002, "Part of the hidden observations inside the image that are reported as visible.", ge=0, le=1
    )
    depth_flicker: float = setting(0.04, "Standard deviation of each frame's depth log-scale.", ge=0, le=1)
    depth_field: float = setting(
        0.02, "Standard deviation of a smooth relative depth error, independent per frame.", ge=0, le=0.5
    )
    depth_pixel: float = setting(0.01, "Standard deviation of each pixel's relative depth error.", ge=0, le=0.5)
    hole_fraction: float = setting(0.01, "Part of each depth map that is missing, in blobs.", ge=0, lt=1)
    mask_error_px: int = setting(
        2,
        "Each instance's mask is grown, shrunk and shifted by up to this, anew in each frame, px.",
        ge=0,
        le=50,
    )
    focal_error: float = setting(
        0.05, "Relative error of the sequence's focal lengths: 0.05 gives them 5 % too long.", gt=-0.9, le=1
    )

    @model_validator(mode="after")
    def _outlier_range_is_ordered(self) -> CueNoise:
        if self.outlier_min_px > self.outlier_max_px:
            raise ValueError(f"outlier_min_px {self.outlier_min_px:g} exceeds {self.outlier_max_px:g}")
        return self

    @classmethod
    def none(cls) -> CueNoise:
        """Return exact cues."""
        return cls(
            track_sigma_px=0.0,
            outlier_fraction=0.0,
            visibility_drop_fraction=0.0,
            false_visibility_fraction=0.0,
            depth_flicker=0.0,
            depth_field=0.0,
            depth_pixel=0.0,
            hole_fraction=0.0,
            mask_error_px=0,
            focal_error=0.0,
        )
