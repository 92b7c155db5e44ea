"""The search for a lens: which distortions are tried, and what must speak for one to be taken."""

from __future__ import annotations

from dataclasses import dataclass, replace

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.camera import CameraConfig
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.depth_trend import depth_trend
from uni4d_fg.slam.lens.fit import FittedLens, HeldOut, LensFit
from uni4d_fg.slam.lens.strength import Strength, strength_of
from uni4d_fg.slam.stages.bundle_adjustment import without_depth_prior

_SOUND_TREND, _TREND = 0.005, 0.025
"""Of depth over the image, beside a cue that is sound with the pinhole and beside one that is not: worth a closer look,
which costs half a second. Pinholes have up to 0.7 and 2.3 %, but for three; k1 of -0.1 to -0.12 has 0.5 to 24 %."""
_CLEAR_TREND = 0.1
"""Of depth that no pinhole has: a lens is looked for, whatever the probe says. kitchen_dog through k1 of -0.12 has 16,
and evidence of 0.14 to 0.21 %, as the tracker finds a few points here or there; held-out tracks tell it apart (1.2 %,
and -0.02 % without a lens)."""
_MIN_EVIDENCE = 0.003
"""Of a solve to the end beside a cue that is believed. Pinholes that explain held-out tracks better have 0.02 % at
most, lenses 0.35 to 10 %; k1 = -0.1 straight down a corridor, where the focal length stays open, 0.1 to 0.2 %."""
_SOON = 1e-5
"""Relative decrease at which a joint solve that only tells whether there is a lens may stop."""


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
class LensSearch:
    """Looks for the lens that the images ask for, at first with one parameter, then with two."""

    fit: LensFit
    """Holds the depth cue loosely: where it contradicts the tracks, distortion would seem to take away energy."""
    believing: LensFit
    """Holds it as bundle adjustment does: it tells the focal length, which a lens leaves open to tracks."""
    held_out: LabelledTracks
    """What models are compared by, on real pixels."""
    settings: CameraConfig
    image_size: tuple[int, int]

    def beside_tracks(self, pinhole: FittedLens) -> tuple[FittedLens, list[LensCandidate], float]:
        """Return the lens that tracks ask for, the pinhole if there is none, what was tried, and the evidence.

        Args:
            pinhole: Fitted with the depth cue held loosely.

        Raises:
            DegenerateProblemError: If the cues do not determine the cameras.
            SolverError: If a system is singular or a cue is not finite.
        """
        evidence = self.fit.probe(pinhole.scene)
        by_cue = evidence < self.settings.min_evidence
        if by_cue and abs(depth_trend(pinhole.scene, self.image_size)) <= _CLEAR_TREND:
            return pinhole, [], evidence
        candidates: list[LensCandidate] = []
        # Errors of a depth cue bend a valley as narrow as that. It has a say where tracks alone tell no lens.
        alone = self.fit.with_stage(without_depth_prior(self.fit.config.bundle_adjustment))
        for trial in (alone, self.fit):
            judge = self._judge_of(trial)
            start = trial.search(self.settings.starts)
            first = trial.refine(start.scene, start.lens, "SIMPLE_RADIAL", self.settings.rounds)
            candidates = [candidate_of(replace(first, evidence=evidence), judge.gain(first, pinhole), self.image_size)]
            if is_taken(candidates[0], self.settings, self.image_size, by_cue=by_cue):
                found = self._richer(trial, judge, first, candidates)
                return self.believing.anew(found, self.settings.rounds), candidates, evidence
        return pinhole, candidates, evidence

    def cue_shows_a_trend(self, pinhole: FittedLens) -> bool:
        """Tell whether the depth cue departs from a pinhole's landmarks toward the corners as a lens makes it."""
        return abs(depth_trend(pinhole.scene, self.image_size)) > (_SOUND_TREND if self.is_sound(pinhole) else _TREND)

    def is_sound(self, pinhole: FittedLens) -> bool:
        """Tell whether the noise of the depth cue beside a pinhole is so low that the cue has the last word."""
        return pinhole.scene.noise.depth_sigma <= self.settings.sound_depth_sigma

    def beside_cue(self, pinhole: FittedLens) -> tuple[FittedLens, list[LensCandidate]]:
        """Return the lens that tracks and depth cue ask for together, the pinhole if there is none, and what was tried.

        Beside depth that is believed the valley between focal length and distortion is wide enough to be crossed from
        the pinhole.

        Args:
            pinhole: Fitted with the depth cue believed.

        Raises:
            DegenerateProblemError: If the cues do not determine the cameras.
            SolverError: If a system is singular or a cue is not finite.
        """
        trial = self.believing
        soon = trial.config.camera.model_copy(update={"relative_decrease": _SOON})
        quick = replace(trial, config=trial.config.model_copy(update={"camera": soon}))
        first = quick.refine(pinhole.scene, Lens(), "SIMPLE_RADIAL")
        judge = self._judge_of(trial)
        candidates = [candidate_of(first, judge.gain(first, pinhole), self.image_size)]
        enough = candidates[0].evidence >= _MIN_EVIDENCE and candidates[0].held_out_gain > 0.0
        # Things that move without a mask asked for k1 = 1.2 on seven tiny frames.
        moderate = abs(first.lens.parameters[0]) <= self.settings.parameter_prior_sigma
        if not (enough and moderate and is_taken(candidates[0], self.settings, self.image_size)):
            return pinhole, candidates
        first = trial.anew(first, self.settings.rounds)
        return self._richer(trial, judge, first, candidates), candidates

    def _richer(self, trial: LensFit, judge: HeldOut, first: FittedLens, candidates: list[LensCandidate]) -> FittedLens:
        """Add a second radial parameter where it is asked for; the candidate is appended to those there are."""
        second = trial.refine(first.scene, first.lens, "RADIAL", self.settings.rounds)
        candidates.append(candidate_of(second, judge.gain(second, first), self.image_size))
        taken = is_taken(candidates[-1], self.settings, self.image_size, after_another=True)
        return second if taken else first

    def _judge_of(self, trial: LensFit) -> HeldOut:
        return HeldOut(trial.config, self.held_out, trial.run, trial.hooks)


def is_taken(
    candidate: LensCandidate,
    settings: CameraConfig,
    image_size: tuple[int, int],
    *,
    after_another: bool = False,
    by_cue: bool = False,
) -> bool:
    """Tell whether the images ask for a lens: energy, distance and held-out tracks must all speak for it.

    Args:
        candidate: The lens and what it gains over the simpler one.
        settings: Limits.
        image_size: (height, width), px.
        after_another: Whether the simpler one is a lens, too, and not the pinhole.
        by_cue: Whether a depth cue asks for a lens, in place of energy.
    """
    enough = settings.min_further_evidence if after_another else settings.min_evidence
    if candidate.evidence < enough and not by_cue:
        return False
    strength = strength_of(candidate.lens, candidate.displacement_px, image_size, settings)
    if not strength.is_lens:
        return False
    weak, little = strength is Strength.WEAK, candidate.evidence < settings.min_evidence_unsure
    if weak and little and not after_another:
        return False
    if after_another or weak or little:
        return candidate.held_out_gain > 0.0
    return candidate.held_out_gain >= -settings.max_held_out_loss


def candidate_of(fit: FittedLens, held_out_gain: float, image_size: tuple[int, int]) -> LensCandidate:
    """Return a fit and what it gains over the simpler one."""
    displacement = fit.lens.displacement(fit.intrinsics, image_size)
    return LensCandidate(fit.lens, fit.intrinsics, fit.evidence, held_out_gain, displacement)
