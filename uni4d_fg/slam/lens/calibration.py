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

from uni4d_fg.arrays import BoolArray, FloatArray, evenly_spread
from uni4d_fg.config.camera import CameraConfig
from uni4d_fg.config.models import Config
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry.lens import PARAMETERS, PINHOLE, Lens, LensModel
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.lens.fit import FittedLens, HeldOut, LensFit, settings_of_fit
from uni4d_fg.slam.lens.strength import Strength, strength_of
from uni4d_fg.slam.lens.zoom import ZoomCalibration, find_zoom, solve_zoom
from uni4d_fg.slam.lens.zoom_fit import ZoomFit
from uni4d_fg.slam.stages.bundle_adjustment import without_depth_prior
from uni4d_fg.slam.stages.depth_spread import depth_spread
from uni4d_fg.slam.stages.observations import observations_of
from uni4d_fg.slam.stages.scene import StaticScene
from uni4d_fg.slam.windows.plan import TrackSpans, calibration_frames, tracks_in

_FAR_BEYOND = 2.0
"""Spread over what counts as poor: through k1 of -0.12 sound cues have 1.7 to 2.4 %, those of networks 8 to 9 %."""


@dataclass(frozen=True)
class LensCandidate:
    """One camera model that was tried."""

    lens: Lens
    intrinsics: FloatArray
    """(4,) px."""
    evidence: float
    """Part of the reprojection energy that its parameters take away."""
    held_out_gain: float
    """Part by which the energy of held-out tracks is lower than with the model before it."""
    displacement_px: float
    """How far it moves a pixel of the image at most."""


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
    if not (labelled.weight[_static(labelled)] > 0).any():
        raise DegenerateProblemError("the lens: there is no static track")
    frames = calibration_frames(TrackSpans.of(labelled), count, settings.frames, config.windows.calibration_sightings)

    def chosen(observations: int) -> LabelledTracks:
        return tracks_in(_thinned(labelled, observations * count // len(frames)), frames).labelled

    some = chosen(settings.observations)
    held_out = np.arange(len(some.label)) % settings.hold_out_every == 0
    config = settings_of_fit(config, consecutive=len(frames) == int(frames[-1]) + 1)
    fit = LensFit(config, some.without(held_out), intrinsics, run, hooks)
    if settings.model not in ("auto", "pinhole"):
        model = cast(LensModel, settings.model.upper())
        lens = _as_model(given or PINHOLE, model)
        found = fit.refine(fit.scene(lens, intrinsics), lens, model, settings.rounds)
        return LensCalibration(found.lens, found.intrinsics, [_candidate(found, 0.0, image_size)], fit.solves)

    pinhole = FittedLens(Lens(), fit.scene(Lens(), intrinsics))
    zoom = None
    if settings.zoom != "off":
        zooming = ZoomFit(fit, frames, chosen(settings.zoom_observations))
        zoom = find_zoom(zooming, pinhole.scene, count, settings)
    if settings.model == "pinhole" or (zoom is not None and zoom.zoom is not None):
        # A lens beside a zoom is not sought.
        known = intrinsics if zoom is None or zoom.zoom is None else zoom.intrinsics
        return LensCalibration(Lens(), known, [], fit.solves, zoom=zoom)
    note = _left_to_tracks(fit, pinhole.scene, config)
    if note:
        return LensCalibration(Lens(), intrinsics, [], fit.solves, note, zoom)
    evidence = fit.probe(pinhole.scene)
    if evidence < settings.min_evidence:
        note = f"distortion would lower the reprojection energy by {100 * evidence:.2f} %"
        return LensCalibration(Lens(), intrinsics, [], fit.solves, note, zoom)
    # Errors of a depth cue bend a valley as narrow as that. It has a say where tracks alone tell no lens.
    stage = without_depth_prior(config.bundle_adjustment)
    alone = replace(fit, config=config.model_copy(update={"bundle_adjustment": stage}))
    for trial in (alone, fit):
        judge = HeldOut(trial.config, some.without(~held_out), run, hooks)
        best, candidates = _find_lens(trial, judge, pinhole, evidence, settings, image_size)
        if best is not pinhole:
            break
    if zoom is not None and zoom.beside_lens:
        compared = solve_zoom(zooming, pinhole.scene, best, count, settings)
        if compared.zoom is not None:
            return LensCalibration(Lens(), compared.intrinsics, candidates, fit.solves, zoom=compared)
        zoom = replace(zoom, notes=zoom.notes + compared.notes)
    known = intrinsics if best is pinhole else best.intrinsics
    return LensCalibration(best.lens, known, candidates, fit.solves, zoom=zoom)


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


def _find_lens(
    fit: LensFit, judge: HeldOut, pinhole: FittedLens, evidence: float, settings: CameraConfig,
    image_size: tuple[int, int],
) -> tuple[FittedLens, list[LensCandidate]]:  # fmt: skip
    """Fit models of one and two parameters; return the richest that is taken, the pinhole if none, and those tried."""
    best, candidates = pinhole, list[LensCandidate]()
    richer: tuple[LensModel, ...] = ("SIMPLE_RADIAL", "RADIAL")
    for model in richer:
        start = best if candidates else fit.search(settings.starts)
        found = fit.refine(start.scene, start.lens, model, settings.rounds)
        if not candidates:
            found = replace(found, evidence=evidence)
        candidate = _candidate(found, judge.gain(found, best), image_size)
        taken = is_taken(candidate, settings, image_size, after_another=bool(candidates))
        candidates.append(candidate)
        if not taken:
            break
        best = found
    return best, candidates


def is_taken(
    candidate: LensCandidate, settings: CameraConfig, image_size: tuple[int, int], *, after_another: bool = False
) -> bool:
    """Tell whether the images ask for a lens: energy, distance and held-out tracks must all speak for it.

    Args:
        candidate: The lens and what it gains over the simpler one.
        settings: Limits.
        image_size: (height, width), px.
        after_another: Whether the simpler one is a lens, too, and not the pinhole.
    """
    if candidate.evidence < (settings.min_further_evidence if after_another else settings.min_evidence):
        return False
    strength = strength_of(candidate.lens, candidate.displacement_px, image_size, settings)
    if strength is Strength.NO_LENS:
        return False
    weak, little = strength is Strength.WEAK, candidate.evidence < settings.min_evidence_unsure
    if weak and little and not after_another:
        return False
    if after_another or weak or little:
        return candidate.held_out_gain > 0.0
    return candidate.held_out_gain >= -settings.max_held_out_loss


def _as_model(lens: Lens, model: LensModel) -> Lens:
    """Return a lens of a model to start from: with the parameters of another of its family, else with zeros."""
    same = lens.is_fisheye == (model == "OPENCV_FISHEYE")
    return Lens.of(model, lens.padded if same else np.zeros(4))


def _candidate(fit: FittedLens, held_out_gain: float, image_size: tuple[int, int]) -> LensCandidate:
    displacement = fit.lens.displacement(fit.intrinsics, image_size)
    return LensCandidate(fit.lens, fit.intrinsics, fit.evidence, held_out_gain, displacement)


def _static(labelled: LabelledTracks) -> BoolArray:
    return np.isin(labelled.label, [int(TrackLabel.STATIC), int(TrackLabel.SHORT_STATIC)])


def _thinned(labelled: LabelledTracks, observations: int) -> LabelledTracks:
    """Keep evenly spread static tracks with about so many observations in all."""
    rows = np.flatnonzero(_static(labelled))
    count = int((labelled.weight[rows] > 0).sum())
    if count > observations:
        rows = rows[evenly_spread(len(rows), max(1, len(rows) * observations // count))]
    return LabelledTracks(
        labelled.tracks.select(rows), labelled.label[rows], labelled.instance[rows], labelled.weight[rows],
        labelled.depth[rows],
    )  # fmt: skip
