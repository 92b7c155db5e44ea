"""The lens, found with the cameras, and whether the images ask for one.

Part of the tracks and frames serve. The test compares nested models: by which part of itself does the reprojection
energy fall when the distortion is set free at the pinhole's minimum? A plain likelihood ratio says yes too soon, as a
tracker errs alike along a track and between neighbors; such errors do not reach a fixed part of the energy. Held-out
tracks decide on small distortions only, which errors of a tracker may mimic: free poses bend so far that a wrong lens
explains them nearly as well, and a large one that is right may explain them worse. The second radial parameter needs
less energy than the first, and a gain on held-out tracks whatever it moves: what a lens of one parameter leaves over
is small, and where nothing is left over the second takes away a fifth of what it must at most.

Focal length and distortion trade against each other along a narrow valley, in which a pinhole ends far from the truth
(its focal length 30 % off where k1 is -0.12). The search therefore starts from several distortions, each undone before
a pinhole is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry.lens import PARAMETERS, PINHOLE, Lens, LensModel
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.fit import FittedLens, LensFit
from uni4d_fg.slam.lens.lens_search import LensCandidate, LensSearch, candidate_of
from uni4d_fg.slam.lens.rolling_shutter import Readout
from uni4d_fg.slam.lens.sample import EXACT_PX, CalibrationSample
from uni4d_fg.slam.lens.sharpness import sharp_frames
from uni4d_fg.slam.lens.zoom import ZoomCalibration, find_zoom, solve_zoom
from uni4d_fg.slam.lens.zoom_fit import ZoomFit
from uni4d_fg.slam.stages.depth_spread import depth_spread
from uni4d_fg.slam.stages.observations import observations_of
from uni4d_fg.slam.stages.scene import StaticScene

_FAR_BEYOND = 2.0
"""Spread over what counts as poor: through k1 of -0.12 sound cues have 1.7 to 2.4 %, those of networks 8 to 9 %."""


@dataclass(frozen=True)
class LensCalibration:
    """What was found, and what was tried."""

    lens: Lens
    intrinsics: FloatArray
    """(4,) px; the given ones with a pinhole."""
    candidates: list[LensCandidate] = field(default_factory=list)
    solves: list[SolveSummary] = field(default_factory=list)
    note: str = ""
    zoom: ZoomCalibration | None = None
    """What was found of a zoom; None where none was sought."""
    focal_sigma: float | None = None
    """Standard deviation of the log of focal lengths that the stages are to hold; None lets them move on."""
    readout: Readout | None = None
    """That the stages are to undo, too (:mod:`uni4d_fg.slam.lens.shutter_calibration`)."""

    @property
    def camera(self) -> CameraModel:
        """Intrinsics, lens and zoom."""
        zoom = None if self.zoom is None else self.zoom.zoom
        return CameraModel(self.intrinsics, self.lens, zoom, self.focal_sigma)

    def facts(self) -> list[str]:
        """Say in words what was chosen and why."""
        chosen = [f"camera model {self.lens.model}"]
        if self.lens.parameters:
            values = zip(PARAMETERS[self.lens.model], self.lens.parameters, strict=True)
            chosen += [", ".join(f"{name} {value:.4f}" for name, value in values), f"fx {self.intrinsics[0]:.1f} px"]
        tried = [
            f"{c.lens.model} lowers the reprojection energy by {100 * c.evidence:.2f} % ({100 * c.held_out_gain:.1f} % "
            f"on held-out tracks) and moves pixels by up to {c.displacement_px:.1f} px"
            for c in self.candidates
        ]
        zoomed = [] if self.zoom is None else self.zoom.notes
        return [", ".join(chosen), *zoomed, *([self.note] if self.note else []), *tried]


def calibrate_lens(
    labelled: LabelledTracks,
    image_size: tuple[int, int],
    intrinsics: FloatArray,
    config: Config,
    given: Lens | None = None,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> LensCalibration:
    """Find the lens and the intrinsics of a video.

    Args:
        labelled: All tracks, on real pixels.
        image_size: (height, width), px.
        intrinsics: (4,) the sequence's own, px.
        config: The camera's section and those of stages 1 and 2.
        given: Lens to start from.
        hooks: Progress and cancellation.
        run: What solves each declared stage.

    Raises:
        DegenerateProblemError: If the cues do not determine the cameras.
        SolverError: If a system is singular or a cue is not finite.
    """
    settings = config.camera
    count = labelled.tracks.num_frames
    sample = CalibrationSample.of(labelled, config, sharp_frames(labelled.tracks.blur_px, count))
    some = sample.cut(sample.tracks(settings.observations))
    held_out = np.arange(len(some.label)) % settings.hold_out_every == 0
    config = sample.settings(config)
    believing = LensFit(config, some.without(held_out), intrinsics, run, hooks)
    fit = believing.with_stage(config.bundle_adjustment.model_copy(update={"first_depth_sigma": None}))
    if settings.model not in ("auto", "pinhole"):
        model = cast(LensModel, settings.model.upper())
        lens = _as_model(given or PINHOLE, model)
        found = believing.anew(fit.refine(fit.scene(lens, intrinsics), lens, model), settings.rounds)
        return LensCalibration(found.lens, found.intrinsics, [candidate_of(found, 0.0, image_size)], fit.solves)

    search = LensSearch(fit, believing, some.without(~held_out), settings, image_size)
    pinhole = FittedLens(Lens(), fit.scene(Lens(), intrinsics))
    measured_px = pinhole.scene.noise.measured_px
    if measured_px < EXACT_PX and settings.zoom != "on":  # parts of next to nothing say nothing
        note = f"a pinhole explains the tracks to {measured_px:.2g} px: nothing is left for a lens or a zoom"
        return LensCalibration(Lens(), intrinsics, [], fit.solves, note)
    left = _left_to_tracks(fit, pinhole.scene, config)
    # What the cue says of a lens is looked at where it shows a trend; if it is sound, that is the last word.
    with_cue, is_sound, candidates = None, False, list[LensCandidate]()
    if settings.model == "auto" and settings.zoom != "on" and not left and search.cue_shows_a_trend(pinhole):
        with_cue = FittedLens(Lens(), believing.scene(Lens(), intrinsics))
        is_sound = search.is_sound(with_cue)
        if is_sound:
            found, candidates = search.beside_cue(with_cue)
            if not found.lens.is_pinhole:
                return LensCalibration(found.lens, found.intrinsics, candidates, fit.solves)
    zoom = None
    if settings.zoom != "off":
        zooming = ZoomFit(fit, sample.frames, sample.cut(sample.tracks(settings.zoom_observations)))
        zoom = find_zoom(zooming, pinhole.scene, count, settings)
    if settings.model == "pinhole" or (zoom is not None and zoom.zoom is not None):
        # A lens beside a zoom is not sought.
        known = intrinsics if zoom is None or zoom.zoom is None else zoom.intrinsics
        return LensCalibration(Lens(), known, [], fit.solves, zoom=zoom)
    if is_sound or left:
        return LensCalibration(Lens(), intrinsics, candidates, fit.solves, left, zoom)
    found, candidates, evidence = search.beside_tracks(pinhole)
    if found.lens.is_pinhole and with_cue is not None:
        found, more = search.beside_cue(with_cue)
        candidates += more
    note = "" if candidates else f"distortion would lower the reprojection energy by {100 * evidence:.2f} %"
    if zoom is not None and zoom.beside_lens:
        rival = pinhole if found.lens.is_pinhole else found
        compared = solve_zoom(zooming, pinhole.scene, rival, count, settings)
        if compared.zoom is not None:
            return LensCalibration(Lens(), compared.intrinsics, candidates, fit.solves, zoom=compared)
        zoom = replace(zoom, notes=zoom.notes + compared.notes)
    known = intrinsics if found.lens.is_pinhole else found.intrinsics
    return LensCalibration(found.lens, known, candidates, fit.solves, note, zoom)


def _left_to_tracks(fit: LensFit, scene: StaticScene, config: Config) -> str:
    """Say so where depths contradict each other by much more than a lens makes them: it is then found without them."""
    limit = config.camera_init.max_depth_spread
    if limit is None:
        return ""
    static = observations_of(fit.tracks, TrackLabel.STATIC, TrackLabel.SHORT_STATIC)
    spread = depth_spread(static, scene.cameras)
    if not spread > _FAR_BEYOND * limit:
        return ""
    return f"no distortion was sought beside depths that depart by {100 * spread:.0f} % from frame to frame"


def _as_model(lens: Lens, model: LensModel) -> Lens:
    """Return a lens of a model to start from: with the parameters of another of its family, else with zeros."""
    same = lens.is_fisheye == (model == "OPENCV_FISHEYE")
    return Lens.of(model, lens.padded if same else np.zeros(4))
