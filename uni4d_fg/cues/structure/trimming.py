"""What most tracks agree on, refined alone: the limit up to which a track agrees follows the noise that is left.

A thing that moves by little between frames, or along its epipolar lines, passes limits of pixels, and a convex kernel
lets it bend the cameras. Its tracks depart from a rigid scene more than the others all the same. So the limit is
lowered with the median residual of what agrees, tracks are judged, and bundle adjustment is repeated with those that
agree, until the limit stays: least trimmed squares (P. Rousseeuw, "Least median of squares regression", 1984), for
which more than half of the observations must be of what stands still. Tracks that were left out are triangulated and
judged again in every round. The limit is low, so that the cameras come loose from what bends them, and they converge
with the tracks that agree within it. Only then others come back, which agree within twice the limit of all of them:
what a lens or a rolling shutter displaces a little is not to be missed, but it has no say in a focal length either.
"""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.triangulation import median_per_row
from uni4d_fg.robust import MEDIAN_OF_NORM

_SETTLED = 0.03
"""Relative change of the limit at which it stays."""
_WIDEN = 2.0
"""What the limit is multiplied by in the end."""
_MOST = 0.5
"""A track of which more than this part of the observations is beyond the limit does not agree."""


def trim(scene: GrowingScene) -> None:
    """Refine a grown scene from the tracks that agree with it within a limit that follows their noise.

    Afterwards ``scene.limit_px`` is the wide limit, and ``scene.left_out`` (M,) the tracks that do not agree within it.

    Args:
        scene: Grown.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    _tighten(scene)
    _widen(scene)


def trim_and_converge(scene: GrowingScene) -> None:
    """Trim a grown scene, and refine it with the tracks that agree, and their noise, until it tells a focal length.

    Tracks that the wide limit lets in again take no part in that; of those that agree all observations within it do.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    _tighten(scene)
    scene.leave_out(scene.left_out, _widened(scene, scene.limit_px))
    scene.measure_noise()
    scene.converge()
    scene.triangulate_all()
    _widen(scene)
    scene.measure_noise()


def _tighten(scene: GrowingScene) -> None:
    """Lower the limit, and refine from the tracks that agree, until it stays."""
    settings = scene.config.geometric_depth
    limit = scene.limit_px
    for _ in range(settings.trim_rounds):
        if not np.isfinite(scene.position).any():
            return
        error, before = scene.errors(), limit
        limit = _limit(scene, np.where(scene.left_out[scene.row], np.inf, error))
        left_out = _disagreeing(scene, error, limit)
        settled = float(np.abs(np.log(limit / before)).max()) < _SETTLED and not (left_out & ~scene.left_out).any()
        scene.leave_out(left_out, limit)
        if settled:
            break
        scene.measure_noise()
        scene.adjust()
        scene.triangulate_all()


def _widen(scene: GrowingScene) -> None:
    """Let tracks come back that agree within twice the limit of all of them, not of those that agree already."""
    if not np.isfinite(scene.position).any():
        return
    error = scene.errors()
    limit = _widened(scene, _limit(scene, error))
    scene.leave_out(_disagreeing(scene, error, limit), limit)


def _limit(scene: GrowingScene, error: FloatArray) -> FloatArray:
    """Return the limits (T,), px, of errors (N,) that follow their noise."""
    settings = scene.config.geometric_depth
    limit = settings.trim_sigmas * _noise(scene, error)
    return np.asarray(np.clip(limit, settings.min_trim_px, settings.max_reprojection_px))


def _widened(scene: GrowingScene, limit_px: FloatArray) -> FloatArray:
    """Return wide limits (T,), px, for those (T,) by which tracks were found to agree."""
    return np.asarray(np.minimum(_WIDEN * limit_px, scene.config.geometric_depth.max_reprojection_px))


def _noise(scene: GrowingScene, error: FloatArray) -> FloatArray:
    """Return the noise of a component of the observations in each frame (T,), px, by medians of the errors (N,).

    That of all observations, or of a frame that has more: what is blurred or turned fast is not to lose its camera.
    Where nothing is seen of any point, it may be as large as it likes.
    """
    seen, frame = _seen(scene, error), scene.observations.frame
    own = median_per_row(error[seen], frame[seen], len(scene.registered))
    usual = np.median(error[seen]) if seen.any() else np.inf
    return np.asarray(np.fmax(own, usual) / MEDIAN_OF_NORM)


def _disagreeing(scene: GrowingScene, error: FloatArray, limit_px: FloatArray) -> BoolArray:
    """Return the tracks (M,) of which most observations, with errors (N,), are beyond the limits (T,)."""
    seen = _seen(scene, error)
    count = np.bincount(scene.row[seen], minlength=scene.num_tracks)
    beyond = np.bincount(scene.row[seen], (error > limit_px[scene.observations.frame])[seen], scene.num_tracks)
    return np.asarray(beyond > _MOST * count)


def _seen(scene: GrowingScene, error: FloatArray) -> BoolArray:
    """Return which observations (N,) have a point and a camera."""
    return np.asarray(scene.registered[scene.observations.frame] & np.isfinite(error))
