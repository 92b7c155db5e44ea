"""Whether the tracks of a grown scene ask for a focal length per frame, and which.

A zoom takes all cameras along: without it they end at several times the focal length, or with near and far exchanged.
But what they make of a zoom along the view is nearly one of the projective maps of
:mod:`uni4d_fg.geometry.plane_at_infinity`, which has one unknown: so a few of these are undone, and what explains most
is refined. Bundle adjustment alone crawls along that valley, and does not get through the exchange.

Where a camera moves across its view rather than along it, a zoom looks like motion along the view with a focal length
that is far too long. Then cameras are grown anew, from tracks that do not zoom as far as a similarity tells: how much
farther apart points are in the next frame. (Motion along the view does that, too; what is too much is found by the
fit.) The focal length is held at what was given until then, as it is what runs away.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.structure.camera_fit import Fitted, TrackJudge, comparing, fit_zoom, part_of, probing
from uni4d_fg.cues.structure.first_pair import CommonTracks
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.lens_agreement import halves_agree_on_zoom
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry.plane_at_infinity import PlaneAtInfinity
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.stages.observations import Observations

Grown = Callable[[Observations, FloatArray], GrowingScene | None]
"""Grows a scene from ideal observations, with intrinsics that are held."""

_RUNS_AWAY = 1.5
"""Factor to the given focal length. With zooms of 1.2 to 1.6, on fourteen clips, it ended at 0.7 to 9 times; where it
was less than this, maps of the cameras found the zoom as well."""
_PROBED = 0.25
"""Part of a zoom that the steps of the probe find, at least."""
_LOUD = 0.015
"""Evidence from which they need not find any: where motion along the view undoes a zoom, its cameras are far away. Up
to 0.9 % on 19 clips that do not zoom; 2 to 5 % on three that do."""
_RATIOS = (0.5, 0.7, 1.4, 2.0)
"""By which the focal length may change along the path, where near and far stay ..."""
_EXCHANGING_RATIOS = (1.2, 1.4, 1.7, 2.0, 3.0)
"""... and where they are exchanged."""
_HALVINGS = 2
"""How often the step between ratios is halved about the best one."""
_SKETCHED = 5000
"""Observations that the maps are compared on."""
_SHORT = {"relative_decrease": 1e-5, "max_iterations": 30}
_CLOSE = 0.1
"""Starts whose cost is above the least by no more than this part of it are all fitted to the end once."""
_TIE = 0.02
"""Costs that differ by less than this part say nothing."""
_ROUNDS = 5
_LEADS_AWAY = 0.005
"""A round that costs more than the one before by this part is not taken, and is the last: it goes on with the tracks
that agree, which may be ever fewer. Rounds that stayed at a zoom cost up to 0.001 more, those that left one 0.01 and
0.05."""
_STEPS = 200
_SETTLED = 0.003
"""Change of the log zoom in a round below which it is found."""
_FAR_APART = 0.1
"""Points nearer to each other than this part of the image's diagonal say little of a similarity."""
_PAIRS = 4000


def asks_for_zoom(plain: Fitted, config: Config) -> bool:
    """Tell whether a zoom is worth a search: from what a few steps with a focal length per frame take away."""
    settings = config.camera
    if settings.zoom != "auto" or settings.model != "auto":
        return settings.zoom == "on"
    posed = np.flatnonzero(plain.scene.registered)
    if posed[-1] + int(np.diff(posed).max(initial=1)) < len(plain.scene.registered):
        return False  # Tracks are too short for so many frames, and nothing would be known of the rest.
    probe = fit_zoom(plain, config, probing(config), settled=True)
    moves = float(np.ptp(_log_zoom(probe))) >= _PROBED * settings.min_zoom
    return (probe.evidence >= settings.min_zoom_evidence and moves) or probe.evidence >= _LOUD


def may_be_zoom(zoom: Fitted, best: Fitted, judge: TrackJudge, config: Config) -> bool:
    """Tell whether the focal length changes enough, alike for halves of the tracks, and explains all of them better."""
    return _varies(zoom, config) and judge.better(zoom, best)[0] > 0.0 and halves_agree_on_zoom(zoom, config)


def explains_most(zoom: Fitted, plain: Fitted, judge: TrackJudge, config: Config) -> bool:
    """Tell whether a zoom explains enough of the tracks better than a camera without it."""
    return judge.better(zoom, plain)[1] >= config.camera.min_zoom_agreement


def find_zoom(
    proposed: CameraModel | None, similar: CameraModel | None, plain: Fitted, judge: TrackJudge, scene: GrowingScene,
    real: Observations, config: Config, grown: Grown,
) -> Fitted | None:  # fmt: skip
    """Return the zoom that explains most tracks; None if most tracks fit the camera that does not zoom better.

    Args:
        proposed: A camera whose zoom is undone, and a scene grown anew.
        similar: Another one, see :func:`similar_zoom`: where cameras that owe nothing to it find no zoom, and their
            focal length has not run away, it is not tried.
        plain: The camera that does not zoom; maps of it are tried, too.
        judge: Of the tracks that are fitted.
        scene: All of which the plain camera has a part.
        real: All observations.
        config: Section ``camera``.
        grown: Grows a scene with another camera.

    Raises:
        Cancelled: If asked to stop.
    """

    def anew(camera: CameraModel) -> list[Fitted]:
        other = grown_anew(camera, plain, real, config, grown)
        return [] if other is None else _fitted([other], judge, config)

    found = _fitted([plain, *_mapped(plain, judge)], judge, config)
    at_hand = len(found)
    if proposed is not None:
        found += anew(proposed)
    if similar is not None and (config.camera.zoom == "on" or not _finds_none(found, judge, scene, config)):
        found += anew(similar)
    if not found:
        return None
    options = comparing(config, _STEPS)
    costs = [judge.cost(one) for one in found]
    close = [number for number, cost in enumerate(costs) if cost <= (1.0 + _CLOSE) * min(costs)]
    ends = {number: judge.anew(fit_zoom(found[number], config, options)) for number in close}
    cost_of = {number: judge.cost(end) for number, end in ends.items()}
    tied = [number for number in close if cost_of[number] <= (1.0 + _TIE) * min(cost_of.values())]
    # Cameras that were grown anew owe nothing to the plain ones, which are wrong: in a tie they are taken.
    first = min(tied, key=lambda number: (number < at_hand, cost_of[number]))
    best, cost = ends[first], cost_of[first]
    for _ in range(1, _ROUNDS):
        if config.camera.zoom == "auto" and judge.better(best, plain)[1] < 0.5:
            return None
        again = judge.anew(fit_zoom(best, config, options))
        cost_again = judge.cost(again)
        if cost_again > (1.0 + _LEADS_AWAY) * cost:
            break
        before, best, cost = best, again, cost_again
        if float(np.ptp(_log_zoom(best) - _log_zoom(before))) < _SETTLED:
            break
    return best


def grown_anew(camera: CameraModel, plain: Fitted, real: Observations, config: Config, grown: Grown) -> Fitted | None:
    """Return another camera with part of what grows with it, to be fitted as the plain one is; None if nothing does."""
    scene = grown(camera.ideal_observations(real), camera.intrinsics)
    if scene is None:
        return None
    part = part_of(scene, config.camera.observations, plain.scene.registered)
    part.free_focal = plain.scene.free_focal
    return Fitted(camera, part)


def _fitted(trials: list[Fitted], judge: TrackJudge, config: Config) -> list[Fitted]:
    """Return the zooms that some cameras lead to in a few steps; those that cannot be solved are left out."""
    found = []
    for trial in trials:
        try:
            found.append(judge.anew(fit_zoom(trial, config, _SHORT)))
        except SolverError:  # That of one start is no reason to do without the others.
            continue
    return found


def _finds_none(found: list[Fitted], judge: TrackJudge, scene: GrowingScene, config: Config) -> bool:
    """Tell whether the best of some cameras hardly zooms, and that of a scene without zoom has a usual focal length."""
    if not found:
        return False
    ran_away = abs(np.log(scene.mean_focal / float(np.mean(scene.prior_intrinsics[:2])))) > np.log(_RUNS_AWAY)
    best = min(found, key=judge.cost)
    return not (ran_away or _varies(best, config))


def _varies(zoom: Fitted, config: Config) -> bool:
    """Tell whether the focal length changes enough to be taken for a zoom."""
    return bool(np.expm1(np.ptp(_log_zoom(zoom))) >= config.camera.min_zoom)


def focal_range(zoom: Fitted) -> tuple[float, float]:
    """Return the shortest and the longest focal length of a camera that zooms, px."""
    focal = float(np.mean(zoom.camera.intrinsics[:2])) * np.exp(_log_zoom(zoom))
    return float(focal.min()), float(focal.max())


def similar_zoom(scene: GrowingScene, image_size: tuple[int, int]) -> CameraModel:
    """Return a camera whose zoom is all that a similarity sees, at the focal length that was given."""
    log_ratio = similarities(scene.observations, len(scene.registered), image_size)
    return CameraModel(scene.prior_intrinsics, zoom=np.exp(log_ratio - log_ratio.max()))


def similarities(observations: Observations, num_frames: int, image_size: tuple[int, int]) -> FloatArray:
    """Return by how much, in logarithms, what is seen grows from the first frame on (T,), as a similarity tells."""
    common = CommonTracks(observations, num_frames)
    far = _FAR_APART * float(np.hypot(*image_size))
    out = np.zeros(num_frames)
    rng = np.random.default_rng(0)
    for frame in range(1, num_frames):
        before, after = (observations.uv[rows] for rows in common.between(frame - 1, frame))
        step = 0.0
        if len(before):
            one, other = rng.integers(len(before), size=(2, _PAIRS))
            apart = np.linalg.norm(before[one] - before[other], axis=1)
            known = apart > far
            if known.any():
                later = np.linalg.norm(after[one] - after[other], axis=1)
                step = float(np.median(np.log(np.maximum(later[known], 1e-9) / apart[known])))
        out[frame] = out[frame - 1] + step
    return out


def _mapped(plain: Fitted, judge: TrackJudge) -> list[Fitted]:
    """Return the best of the cameras that zoom and see what one that does not was fitted to, of either kind."""
    few = judge.real.select(judge.real.thinned(_SKETCHED))
    sketch = TrackJudge(few, judge.sigma_px)
    posed = plain.scene.world_T_cam[plain.scene.registered]

    def best_of(ratios: tuple[float, ...], exchanges: bool) -> PlaneAtInfinity | None:
        tried: dict[float, tuple[float, PlaneAtInfinity]] = {}
        near = list(np.log(ratios))
        for _ in range(1 + _HALVINGS):
            for log_ratio in near:
                plane = PlaneAtInfinity.across(posed, float(np.exp(log_ratio)), exchanges=exchanges)
                if plane is not None:
                    tried[log_ratio] = sketch.cost(_with_plane_at_infinity(plain, plane)), plane
            if not tried:
                return None
            at = sorted(tried)
            best = min(at, key=lambda log_ratio: tried[log_ratio][0])
            near = [0.5 * (one + other) for one, other in pairwise(at) if best in (one, other)]
        return tried[best][1]

    planes = best_of(_RATIOS, exchanges=False), best_of(_EXCHANGING_RATIOS, exchanges=True)
    return [judge.anew(_with_plane_at_infinity(plain, plane)) for plane in planes if plane is not None]


def _with_plane_at_infinity(plain: Fitted, plane: PlaneAtInfinity) -> Fitted:
    """Return the cameras that a projective map makes of one that does not zoom, with the points of before."""
    scene, frames = plain.scene, np.flatnonzero(plain.scene.registered)
    poses = scene.world_T_cam.copy()
    poses[frames], growth = plane.cameras(poses[frames])
    log_zoom = np.interp(np.arange(len(poses)), frames, np.log(growth))
    camera = CameraModel.of_log_zoom(plain.camera.intrinsics, log_zoom)
    return Fitted(camera, replace(scene, world_T_cam=poses, intrinsics=camera.intrinsics.copy()))


def _log_zoom(fitted: Fitted) -> FloatArray:
    zoom = fitted.camera.zoom
    return np.zeros(len(fitted.scene.registered)) if zoom is None else np.log(zoom)
