"""Static depth of one frame at working size: several views where they are sure, the corrected cue elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import erf

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.results.fusion.bleeding import across_edges, mixing_sigma
from uni4d_fg.results.fusion.cue_error import CorrectedCue, KnownDepth, correct_cue
from uni4d_fg.results.fusion.log_range import log_range
from uni4d_fg.results.fusion.multiview.measured import Measured
from uni4d_fg.results.fusion.wide_window import blurred
from uni4d_fg.results.nearest import from_nearest
from uni4d_fg.robust import robust_sigma

_LANDMARK_SIGMA = 0.006
"""Standard deviation of a landmark's log depth in a frame."""
_LANDMARK_SHARE = 0.5
"""Weight of a landmark beside a sure match."""
_JUDGING = 0.5
"""Landmarks that have less than this part of it judge nothing."""
_SURE = 0.8
_RIGHT = 0.03
_MEAN_TO_SIGMA = 1.2533
"""Standard deviation over mean absolute error, of a normal distribution."""
_FITTED_ERROR = 1.2
"""Its error over that at landmarks beside those that it was fitted to, on scenes with truth."""
_LEAST_ERROR = 1e-5
_OWN_SOURCE = 0.0025
"""Landmarks are off by more than this themselves."""
_TRACKED_PX = 5
"""Half a tracking window, working px."""
_MIN_COMPARED = 20
"""Landmarks on sure matches that a comparison takes; with fewer, matched depth is taken to be off by ..."""
_UNCHECKED_SIGMA = 0.05
_HELD_OUT = 0.25
"""Part of the landmarks that judge whether the cue or matching is better."""
_AGREES = 0.04
_AT_WORST, _AT_BEST = 0.75, 0.92
"""Parts of the landmarks that agree with sure matches to that log depth: with the first nothing is believed of them."""
_WRONG_SIGMA = 0.3
"""Standard deviation of log depth where a match or the cue is wrong."""
_USUALLY_RIGHT = 0.98
"""Probability that a cue is right where there is nothing to compare it with ..."""
_PRIOR_SHARE = 0.05
"""... which counts as much as this part of the pixels around."""
_BLUR_PX = 2
"""Matched edges are blurred by this, working px."""
_BLUR_WINDOW = np.ones((2 * _BLUR_PX + 1,) * 2, np.uint8)
_NEARBY_PX = 4.0
_EDGE = 0.1
"""Change of log depth that is an edge."""
_LEAST_SIGMA = 0.003
_UNCOMPARED_SIGMA = 0.1
"""Of a cue that nothing can be compared with."""
_MIXED_RIGHT = 0.3
"""Probability that a cue is right where it mixes two surfaces ..."""
_FOREIGN_RIGHT = 0.05
"""... and the same of depth that was carried from other frames, or interpolated between points."""
_FILLED_PX = 2.0
"""Edges that are not the image's are taken from the nearest sure surface so far, working px."""
_FILLED_RIGHT = 0.5
"""Probability that the nearest surface is the right one."""
_JUDGES = 0.5
"""Matched depth that is less reliable does not judge the cue."""


@dataclass(frozen=True)
class StaticDepth:
    """Static depth of one frame, (h, w) each."""

    log_depth: Float32Array
    """NaN where nothing is known."""
    sigma: float
    """Standard deviation of its error where it is right: the median one."""
    confidence: Float32Array
    """Probability that it is right to 3 %, as far as one frame knows."""
    corrected: CorrectedCue
    """The cue alone."""
    matched: Float32Array
    """Confidence in matched depth alone; 0 where there is none."""


@dataclass(frozen=True)
class Known:
    """What one frame's cue is corrected and judged by."""

    depth: KnownDepth
    shared_sigma: float
    """Standard deviation of the error of matched log depth that neighboring pixels share."""
    reliability: float
    """0 to 1: how far the confidence in matched depth is to be believed in this frame."""


def known_depth(
    measured: Measured | None,
    uv: FloatArray,
    log_z: FloatArray,
    static: BoolArray,
    shape: tuple[int, int],
    share: FloatArray | None = None,
) -> Known:
    """Bring depth from several views and landmarks onto one grid.

    Few views know less of depth than landmarks, which all frames together place: what the matched depth differs from
    them by, beyond their own noise, is an error that pixels near each other share. Where it often contradicts them
    (blurred frames, a rolling shutter, poor cameras), it is believed less than it asks for.

    Args:
        measured: Depth from several views, if there is any.
        uv: (N, 2) landmarks, working px.
        log_z: (N,) their log depth.
        static: (h, w) where nothing moves.
        shape: (h, w).
        share: (N,) part of its weight that a landmark has, 0 to 1; None for all of it.
    """
    column, row = np.rint(uv).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    inside[inside] = static[row[inside], column[inside]]
    at, log_z = (row[inside], column[inside]), log_z[inside]
    landmark = np.full(len(log_z), _LANDMARK_SHARE) if share is None else _LANDMARK_SHARE * share[inside]
    log_depth = np.full(shape, np.nan, np.float32)
    weight = np.zeros(shape, np.float32)
    shared, reliability = 0.0, 0.0
    if measured is not None:
        log_depth = measured.log_depth.copy()
        weight = np.where(static, np.maximum(measured.confidence - 0.5, 0) * 2, np.float32(0)).astype(np.float32)
        sure = (
            (measured.confidence[at] > _SURE) & ~_beside_edges(measured)[at] & (landmark >= _JUDGING * _LANDMARK_SHARE)
        )
        shared = _UNCHECKED_SIGMA
        if np.count_nonzero(sure) >= _MIN_COMPARED:
            difference = log_depth[at][sure] - log_z[sure]
            difference -= np.median(difference)
            spread = robust_sigma(difference)
            shared = float(np.sqrt(max(spread**2 - _LANDMARK_SIGMA**2, 0.0)))
            agreeing = float(np.mean(np.abs(difference) < _AGREES))
            reliability = float(np.clip((agreeing - _AT_WORST) / (_AT_BEST - _AT_WORST), 0.0, 1.0))
        # Squared: pixels that share an error are not as many witnesses as there are pixels.
        weight *= np.float32(reliability * (_LANDMARK_SIGMA**2 / (_LANDMARK_SIGMA**2 + shared**2)) ** 2)
    trusted = weight[at] < landmark
    at = at[0][trusted], at[1][trusted]
    log_depth[at] = log_z[trusted]
    weight[at] = landmark[trusted]
    return Known(KnownDepth(log_depth, weight), shared, reliability)


def fuse_static(
    cue: Float32Array,
    measured: Measured | None,
    known: Known,
    cue_error: float,
    static: BoolArray,
    like_moving: BoolArray,
    default_log_scale: float,
    bleeding_px: float,
    config: FusionConfig,
    foreign_edges: bool = False,
) -> StaticDepth:
    """Weigh the corrected cue and the depth from several views by their precision.

    Args:
        cue: (h, w) m, NaN where missing.
        measured: Depth from several views, if there is any.
        known: What the cue is corrected by.
        cue_error: Mean error of the corrected log cue, as held-out landmarks tell; NaN where they do not.
        static: (h, w) where nothing moves.
        like_moving: (h, w) what looks like a moving thing beside its mask.
        default_log_scale: Of the frame, where next to nothing is known.
        bleeding_px: How far the cue bleeds across edges, working px: what it mixes is left to matching where that says
            anything, and beside masks, where nothing is matched, to the nearest static surface.
        config: Fusion.
        foreign_edges: The cue does not have the edges of this image: it is carried from other frames, or interpolated.
    """
    corrected = correct_cue(cue, known.depth, default_log_scale, config)
    if measured is None or known.reliability == 0.0:
        # The cue errs less where landmarks have corrected it, but frames are compared everywhere.
        usual = corrected.error.spread if np.isfinite(corrected.error.spread) else _UNCOMPARED_SIGMA
        error = _MEAN_TO_SIGMA * cue_error if np.isfinite(cue_error) else usual
        sure = np.where(np.isfinite(corrected.log_depth), probability_right(np.float32(error)), np.float32(0))
        nothing = np.zeros_like(corrected.log_depth)
        return StaticDepth(corrected.log_depth, max(usual, _LANDMARK_SIGMA), sure, corrected, nothing)
    cue_sigma, cue_right = trust_in_cue(corrected.log_depth, measured, known)
    has_cue = np.isfinite(corrected.log_depth)
    mixed = np.zeros_like(static)
    if bleeding_px > 0:
        cue_sigma = np.hypot(cue_sigma, mixing_sigma(corrected.log_depth, bleeding_px))
        mixed = across_edges(corrected.log_depth, bleeding_px)
        cue_right = np.where(mixed, np.minimum(cue_right, _FOREIGN_RIGHT if foreign_edges else _MIXED_RIGHT), cue_right)
    seen = measured.log_depth
    p = np.clip(known.reliability * measured.confidence, 1e-3, 1 - 1e-3)
    difference = np.where(has_cue, seen - np.where(has_cue, corrected.log_depth, 0), 0)
    matched = np.hypot(measured.sigma, np.float32(known.shared_sigma))
    # Three explanations: both are right, the match alone is, or the cue alone is.
    both = p * cue_right * _normal(difference, matched**2 + cue_sigma**2)
    match_alone = p * (1 - cue_right) * _normal(difference, _WRONG_SIGMA**2 + matched**2)
    cue_alone = (1 - p) * cue_right * _normal(difference, _WRONG_SIGMA**2 + cue_sigma**2)
    gain = cue_sigma**2 / (matched**2 + cue_sigma**2)
    gain = np.where(both > np.maximum(match_alone, cue_alone), gain, match_alone > cue_alone)
    gain = np.where(has_cue, gain, 1.0)
    log_depth = np.where(has_cue, np.where(has_cue, corrected.log_depth, 0) + gain * difference, seen)
    filled, source = mixed & ~static, static
    if foreign_edges and mixed.any():
        unsure = mixed & (p < _SURE)
        source = static & ~unsure
        filled |= unsure & (cv2.distanceTransform((~source).astype(np.uint8), cv2.DIST_L2, 5) <= _FILLED_PX)
    filled &= ~like_moving
    if filled.any():
        log_depth = np.where(filled, from_nearest(log_depth.astype(np.float32), source), log_depth)
    sigma = np.hypot((1 - gain) * cue_sigma, gain * matched)
    # What the explanation that was chosen has of all, and the depth of the others would be wrong.
    chosen = np.maximum(both, np.maximum(match_alone, cue_alone))
    neither = (1 - p) * (1 - cue_right) * _normal(difference, np.full_like(difference, 2 * _WRONG_SIGMA**2))
    share = np.where(has_cue, chosen / (both + match_alone + cue_alone + neither), p)
    share[filled] = _FILLED_RIGHT
    sure = share * probability_right(sigma)
    return StaticDepth(
        log_depth.astype(np.float32),
        float(np.nanmedian(sigma)),
        sure.astype(np.float32),
        corrected,
        measured.confidence,
    )


def probability_right(sigma: Float32Array | np.float32) -> Float32Array:
    """Return the probability that log depth of this standard deviation is right to 3 %, of the same shape."""
    return np.asarray(erf(_RIGHT / (np.sqrt(2.0) * np.maximum(sigma, 1e-6))), dtype=np.float32)


class HeldOut(NamedTuple):
    """Mean errors of log depth at landmarks that were held out; NaN where too few are."""

    cue: float
    """Of the cue that the other landmarks have corrected, everywhere; of the true error, as far as it is known."""
    matching: float
    """Of matched depth where it is sure, over that of the cue there; NaN without any."""
    telling: bool
    """False if landmarks agree with the cue better than they agree with the truth: it was made from them."""


def held_out_errors(
    cue: Float32Array,
    measured: Measured | None,
    uv: FloatArray,
    log_z: FloatArray,
    static: BoolArray,
    default_log_scale: float,
    config: FusionConfig,
    share: FloatArray | None = None,
) -> HeldOut:
    """Judge the corrected cue and matched depth by landmarks that neither has seen.

    A cue that was fitted to many landmarks agrees with them however wrong it is in between.

    Args:
        cue: (h, w) m, NaN where missing.
        measured: Depth from several views, if there is any.
        uv: (N, 2) landmarks, working px.
        log_z: (N,) their log depth.
        static: (h, w) where nothing moves.
        default_log_scale: Of the frame, where next to nothing is known.
        config: Fusion.
        share: (N,) part of its weight that a landmark has, 0 to 1; None for all of it.
    """
    if share is not None:
        uv, log_z = uv[share >= _JUDGING], log_z[share >= _JUDGING]
    held = np.random.default_rng(0).random(len(log_z)) < _HELD_OUT
    shape = (cue.shape[0], cue.shape[1])
    others = known_depth(None, uv[~held], log_z[~held], static, shape)
    corrected = correct_cue(cue, others.depth, default_log_scale, config).log_depth
    judges = known_depth(None, uv[held], log_z[held], static, shape).depth

    def mean_error(log_depth: Float32Array, where: BoolArray) -> float:
        difference = np.minimum(np.abs(log_depth[where] - judges.log_depth[where]), _WRONG_SIGMA)
        return float(difference.mean()) if len(difference) >= _MIN_COMPARED else float("nan")

    compared = (judges.weight > 0) & np.isfinite(corrected)
    of_cue = _FITTED_ERROR * mean_error(corrected, compared)
    if measured is None:
        return HeldOut(of_cue, float("nan"), True)
    # Tracking windows reach across edges: landmarks beside them bleed as a cue does.
    beside = cv2.dilate(_beside_edges(measured).astype(np.uint8), np.ones((2 * _TRACKED_PX + 1,) * 2, np.uint8)) > 0
    sure = compared & ~beside & (measured.confidence > _SURE)
    error = mean_error(corrected, sure)
    ratio = mean_error(measured.log_depth, sure) / max(error, _LEAST_ERROR)
    return HeldOut(of_cue, ratio, not error < _OWN_SOURCE)


def without_edges(measured: Measured, cue: Float32Array) -> Measured:
    """Return matched depth that says nothing beside edges, which a cue that does not bleed has sharper.

    Args:
        measured: Depth from several views.
        cue: (h, w) m, NaN where missing.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        log_cue = np.log(cue)
    log_cue = np.where(np.isfinite(log_cue), log_cue, measured.log_depth)
    beside = (_beside_edges(measured) | _changes(log_cue)).astype(np.uint8)
    said = np.where(cv2.dilate(beside, _BLUR_WINDOW) > 0, np.float32(0), measured.confidence)
    return replace(measured, confidence=said)


def _beside_edges(measured: Measured) -> BoolArray:
    """Return where matching, which blurs edges by its window, may have mixed two surfaces, (h, w)."""
    return _changes(measured.log_depth)


def _changes(log_depth: Float32Array) -> BoolArray:
    return np.asarray(log_range(log_depth, _BLUR_WINDOW) > _EDGE)


def trust_in_cue(log_cue: Float32Array, measured: Measured, known: Known) -> tuple[Float32Array, Float32Array]:
    """Return the standard deviation (h, w) of a corrected cue where it is right, and the probability that it is.

    Matching blurs edges by its window, so that pixels beside an edge of the matched depth do not witness against
    the cue; those a little farther away do: a cue that bleeds across edges is found out there.
    """
    usable = np.isfinite(log_cue) & (known.depth.weight > 0) & ~_beside_edges(measured)
    left = np.where(usable, np.abs(known.depth.log_depth - log_cue), np.float32(0))
    if not usable.any():
        return np.full_like(log_cue, 0.05), np.full_like(log_cue, _USUALLY_RIGHT)
    usual = robust_sigma(left[usable])
    if known.reliability < _JUDGES:
        return np.full_like(log_cue, max(usual, _LEAST_SIGMA)), np.full_like(log_cue, _USUALLY_RIGHT)
    wrong = usable & (left > 4.0 * usual + 0.02)
    near = cv2.GaussianBlur(np.dstack((usable, wrong)).astype(np.float32), (0, 0), _NEARBY_PX)
    count, failures = near[..., 0], near[..., 1]
    right = 1 - (failures + _PRIOR_SHARE * (1 - _USUALLY_RIGHT)) / (count + _PRIOR_SHARE)
    fine = usable & ~wrong
    far = blurred(np.dstack((fine.astype(np.float32), np.where(fine, left, np.float32(0)) ** 2)), 4 * _NEARBY_PX)
    mass, squares = far[..., 0], far[..., 1]
    noise = np.nanmedian(measured.sigma) ** 2 + known.shared_sigma**2
    variance = (squares + _PRIOR_SHARE * usual**2) / (mass + _PRIOR_SHARE) - noise
    return np.sqrt(np.maximum(variance, _LEAST_SIGMA**2)).astype(np.float32), right.astype(np.float32)


def _normal(difference: FloatArray | Float32Array, variance: FloatArray | Float32Array) -> Float32Array:
    """Return a normal density, (h, w), but for a constant factor."""
    density = np.exp(-0.5 * np.minimum(difference**2 / variance, 100)) / np.sqrt(variance)
    return np.asarray(density, dtype=np.float32)
