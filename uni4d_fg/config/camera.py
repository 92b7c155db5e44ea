"""Configuration of the camera model."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import field_validator, model_validator

from uni4d_fg.config.base import Section, setting

ModelChoice: TypeAlias = Literal["auto", "pinhole", "simple_radial", "radial", "opencv", "opencv_fisheye"]


class CameraConfig(Section):
    """The lens: given, or found with the cameras."""

    model: ModelChoice = setting(
        "auto",
        "Camera model, by COLMAP's names; 'auto' starts at the pinhole and adds radial distortion where the images "
        "ask for it.",
        basic=True,
    )
    zoom: Literal["auto", "on", "off"] = setting(
        "auto",
        "'auto' gives each frame a focal length of its own where the images ask for it; 'on' always does; 'off' is for "
        "a lens that cannot zoom.",
    )
    zoom_per_frame: float = setting(
        0.03, "Standard deviation of the change of the log focal length from frame to frame.", gt=0, le=1
    )
    min_zoom_evidence: float = setting(
        0.003, "Part of the reprojection energy that a focal length per frame must take away to be taken.", ge=0, lt=1
    )
    min_zoom: float = setting(0.05, "Part by which the focal length must vary to be taken for a zoom.", gt=0, lt=1)
    min_zoom_agreement: float = setting(
        0.6,
        "Part of the tracks that a zoom must explain better than a camera that does not zoom, to be taken: half say "
        "nothing, and a thing that moves without a mask speaks for itself alone.",
        ge=0,
        le=1,
    )
    rolling_shutter: float | Literal["off", "auto"] = setting(
        "auto",
        "Rows that are read one after the other: the time from the first to the last, s (negative: the last one is "
        "read first); 'auto' finds it where the tracks ask for it; 'off': all at once. Cameras are those of the middle "
        "rows.",
    )
    readout_axis: Literal["rows", "columns"] = setting(
        "rows", "What is read one after the other, where that time is given: columns in a video turned on its side."
    )
    min_readout_evidence: float = setting(
        0.03,
        "Part of the reprojection energy that reading rows one after the other must take away to be taken.",
        ge=0,
        lt=1,
    )
    observations: int = setting(20000, "Observations that the lens is found from, at most.", ge=1000)
    zoom_observations: int = setting(60000, "Observations that a zoom is refined on, at most.", ge=1000)
    frames: int = setting(60, "Frames that the lens is found from, at most.", ge=3)
    hold_out_every: int = setting(5, "Every so many tracks, one is held out to judge the models.", ge=2)
    sound_depth_sigma: float = setting(
        0.04,
        "Relative noise of the depth cue, measured beside a pinhole, up to which tracks and cue together decide on a "
        "lens.",
        ge=0,
    )
    starts: tuple[float, ...] = setting((-0.3, -0.15, 0.15), "Distortions k1 from which the search starts.")
    rounds: int = setting(2, "Joint solves; between them, outliers are judged anew.", ge=1)
    relative_decrease: float = setting(
        1e-7, "A joint solve stops when a step lowers the energy by less than this part.", gt=0, lt=1
    )
    parameter_prior_sigma: float = setting(0.5, "Sigma of the prior on every distortion parameter, about zero.", gt=0)
    max_iterations: int = setting(100, "Linearizations of a joint solve, at most.", ge=1)
    probe_steps: int = setting(2, "Undamped steps from which the evidence for distortion is read.", ge=1)
    min_evidence: float = setting(
        0.002, "Part of the reprojection energy that free distortion must take away to be taken.", ge=0, lt=1
    )
    min_further_evidence: float = setting(
        0.001,
        "Part of what one radial parameter leaves of that energy that a second one must take away to be taken.",
        ge=0,
        lt=1,
    )
    min_displacement_px: float = setting(1.0, "Distance by which it must move some pixel of the image, px.", ge=0)
    max_pincushion: float = setting(
        0.05,
        "Part of the longer image side by which a lens moves a pixel outward at most: more makes up for something "
        "else. (Tele lenses move the corners by 0.01, and wide ones move them inward.)",
        gt=0,
    )
    sure_displacement: float = setting(
        0.02, "Part of the longer image side below which that distance needs a gain on held-out tracks too.", ge=0, le=1
    )
    min_evidence_unsure: float = setting(
        0.01,
        "Part of the reprojection energy that a lens below that distance must take away; one beyond it that takes away "
        "less needs a gain on held-out tracks, too.",
        ge=0,
        lt=1,
    )
    max_held_out_loss: float = setting(
        0.1, "Part by which it may explain held-out tracks worse, however far it moves pixels.", ge=0
    )

    @property
    def to_the_end(self) -> dict[str, float]:
        """Return the settings of a solver that fits a lens or a zoom until it stays."""
        return {"relative_decrease": self.relative_decrease, "max_iterations": self.max_iterations}

    @property
    def reads_at_once(self) -> bool:
        """Whether all rows are known to be read at the same time."""
        return self.rolling_shutter in ("off", 0.0)

    @property
    def given_readout(self) -> float | None:
        """The time from the first row to the last, s, where it is given and not zero."""
        given = self.rolling_shutter
        return given if isinstance(given, float) and given else None

    @field_validator("starts")
    @classmethod
    def _starts_are_few_and_small(cls, starts: tuple[float, ...]) -> tuple[float, ...]:
        if not starts or any(not -1.0 < k1 < 1.0 for k1 in starts):
            raise ValueError("needs at least one distortion, each between -1 and 1")
        return starts

    @model_validator(mode="after")
    def _zoom_has_no_lens(self) -> CameraConfig:
        if self.zoom == "on" and self.model not in ("auto", "pinhole"):
            raise ValueError(f"zoom 'on' goes with model 'auto' or 'pinhole', not with '{self.model}'")
        return self
