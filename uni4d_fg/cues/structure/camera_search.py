r"""Whether the tracks of a grown scene ask for a lens, or for a focal length per frame, and which.

A pinhole that was fitted to tracks of another camera is a minimum that two steps with little damping leave, as in
:mod:`uni4d_fg.slam.lens`: on clips without a lens or zoom they take away 0.07 % of the reprojection energy by
distortion and change a focal length per frame by 1 % at most, on others 0.6 % and 2.6 % at least. Only where more is
found another camera is looked for.

A lens bends the cameras little, so that its search starts from them. Bundle adjustment with a lens goes part of the way
only, as the tracks that agree with a pinhole are those that a lens bends least; with tracks judged and triangulated
anew, two or three rounds end at the lens, from a focal length of twice its own (k1 of -0.25), too.

A zoom takes all cameras along: without it they end at several times the focal length. So they are grown anew, from
tracks that do not zoom as far as a similarity tells: how much farther apart points are in the next frame. (Motion
along the view does that, too; bundle adjustment with a focal length per frame then tells them apart.) The focal length
is held at what was given until then, as it is what runs away.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.cues.structure.first_pair import CommonTracks
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.reversal import exchanged_and_refined
from uni4d_fg.cues.structure.trimming import trim
from uni4d_fg.errors import Cancelled, SolverError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, OPENCV_CAMERA, POSE, ZOOM
from uni4d_fg.geometry.lens import PARAMETERS, Lens, LensModel
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.problems import RealPixels, lens_problem, zoom_problem
from uni4d_fg.slam.lens.sharpness import sharp_frames
from uni4d_fg.slam.lens.strength import Strength, strength_of
from uni4d_fg.slam.stages.energy import MAP
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.windows.plan import TrackSpans, calibration_frames

Grown = Callable[[Observations, FloatArray], GrowingScene | None]
"""Grows a scene from ideal observations, with intrinsics that are held."""

_DAMPING = 1e-6
"""Of the probe: the scale of a scene is held by a weak prior only, so that steps are not quite undamped."""
_PROBED = 0.4
"""Part of a zoom that the steps of the probe find, at least."""
_MIN_LENS_EVIDENCE = 0.003
"""Part of the reprojection energy that distortion must take away for a lens to be looked for."""
_MIN_SECOND_EVIDENCE = 0.004
"""Part of what a lens of one parameter leaves that a second one must take away: 0.31 % at most where there is none, and
k2 of 0.03 beside k1 of -0.1 takes 0.5 to 3.6 %."""
_LENS_ROUNDS = 4
_LENS_STAYS = 0.003
"""Change of k1 in a round below which it is found."""
_HOPELESS = 0.2
"""Part by which a lens has more energy than a rival, after a round, at which no other round follows: a scene with near
and far exchanged that took over had 0.15 less from the first round on, one that did not had 0.66 more."""
_ZOOM_ROUNDS = 3
_ZOOM_STEPS = 200
_SETTLED = 0.003
"""Change of the log zoom in a round below which it is found."""
_FAR_APART = 0.1
"""Points nearer to each other than this part of the image's diagonal say little of a similarity."""
_PAIRS = 4000
_LOST = 50.0
"""Errors, in sigmas, are cut here: what a camera does not explain counts as much."""
_MAX_FRAMES = 120
"""Frames that cameras are compared on, at most: a focal length per frame makes the system of the cameras dense."""
_SIGHTINGS = 4
"""In so many of them an average track is seen at least."""


@dataclass(frozen=True)
class _Fitted:
    """A camera that was fitted, and the poses that go with it."""

    camera: CameraModel
    scene: GrowingScene
    evidence: float = 0.0
    """Part of the reprojection energy that setting the camera free took away."""


@dataclass(frozen=True)
class FoundCamera:
    """A camera that is no plain pinhole."""

    camera: CameraModel
    lens_gain: float
    """Part of the reprojection energy that a lens takes away, if one was looked for."""


def find_camera(
    scene: GrowingScene,
    real: Observations,
    image_size: tuple[int, int],
    config: Config,
    grown: Grown,
    proposed: CameraModel | None = None,
    blur_px: Float32Array | None = None,
) -> FoundCamera | None:
    """Return the camera that the tracks ask for, or None where that is a pinhole that does not zoom.

    Args:
        scene: Grown with such a pinhole.
        real: All observations, as the images show them.
        image_size: (height, width), px.
        config: Section ``camera``: which cameras to look for.
        grown: Grows a scene with another camera.
        proposed: A camera from elsewhere: its zoom, if it has one, is tried whatever the scene asks for.
        blur_px: (T,) of the frames, where it is known: sharp ones tell the lens.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    settings = config.camera
    sharp = sharp_frames(blur_px, len(scene.registered))
    part = part_of(scene, settings.observations, sharp)
    if not part.good.any():
        return None
    plain = _Fitted(CameraModel(part.intrinsics), part)
    starts = [proposed] if proposed is not None and proposed.zoom is not None else []
    if _asks_for_zoom(plain, config):
        log_ratio = similarities(scene.observations, len(scene.registered), image_size)
        starts.append(CameraModel(scene.prior_intrinsics, zoom=np.exp(log_ratio - log_ratio.max())))
    asks_for_lens = settings.model == "auto" and (
        _joint(plain, "SIMPLE_RADIAL", config, _probing(config)).evidence >= _MIN_LENS_EVIDENCE
    )
    if not (starts or asks_for_lens):
        return None
    judge = _Judge(part.observations, config.bundle_adjustment.reprojection_sigma_px)
    best, gain = plain, 0.0
    if asks_for_lens:
        lens = _find_lens(plain, judge, config)
        gain = judge.better(lens, plain)[0]
        if is_lens(lens.camera, image_size, gain, config):
            best = lens
    for start in starts:
        zoom = _find_zoom(start, plain, judge, scene, real, config, grown)
        if zoom is not None and (settings.zoom == "on" or _is_zoom(zoom, plain, best, judge, config)):
            best = zoom
    return None if best is plain else FoundCamera(best.camera, gain)


def part_of(scene: GrowingScene, observations: int, frames: BoolArray) -> GrowingScene:
    """Return the scene with evenly spread tracks that have about so many observations together, in some of (T,)."""
    seen = scene.observations.select(frames[scene.observations.frame])
    _, row = seen.rows()
    count = np.bincount(row)
    last = np.cumsum(count) - 1
    spans = TrackSpans(seen.frame[last - count + 1], seen.frame[last], count)
    chosen = np.zeros(len(scene.registered), dtype=bool)
    chosen[calibration_frames(spans, len(chosen), _MAX_FRAMES, _SIGHTINGS)] = True
    seen = seen.select(chosen[seen.frame]).with_min_observations(2)
    return _scene_of(seen.select(seen.thinned(observations)), replace(scene, registered=scene.registered & chosen))


def _scene_of(ideal: Observations, cameras: GrowingScene) -> GrowingScene:
    """Return what the cameras of a scene see of other observations, trimmed."""
    scene = cameras.seeing(ideal)
    trim(scene)
    scene.measure_noise()
    return scene


@dataclass(frozen=True)
class _Judge:
    """Compares cameras by tracks that are triangulated anew."""

    real: Observations
    """As the images show them."""
    sigma_px: float

    def energies(self, fitted: _Fitted) -> FloatArray:
        """Return the mean robust energy (K,) of each track on real pixels; NaN where its rays are too parallel."""
        tracks, _ = self.real.rows()
        scene = fitted.scene.seeing(fitted.camera.ideal_observations(self.real))
        seen = scene.observations
        size = fitted.camera.ideal_weight(seen.uv, seen.frame)
        error = np.minimum(scene.errors() * np.sqrt(size) / self.sigma_px, _LOST)
        row = np.searchsorted(tracks, seen.track)
        count = np.bincount(row, minlength=len(tracks))
        known = np.isin(tracks, seen.track[np.isfinite(scene.position[scene.row, 0])])
        energy = np.bincount(row, np.log1p(error**2), len(tracks)) / np.maximum(count, 1)
        return np.where(known, energy, np.nan)

    def better(self, fitted: _Fitted, rival: _Fitted) -> tuple[float, float]:
        """Return by which part a camera lowers the energy of the tracks that both have a point of, and of how many."""
        ours, theirs = self.energies(fitted), self.energies(rival)
        known = np.isfinite(ours) & np.isfinite(theirs)
        if not known.any():
            return 0.0, 0.0
        ours, theirs = ours[known], theirs[known]
        return 1.0 - float(ours.sum() / max(theirs.sum(), 1e-300)), float(np.mean(ours < theirs))


def _asks_for_zoom(plain: _Fitted, config: Config) -> bool:
    settings = config.camera
    if settings.zoom != "auto" or settings.model != "auto":
        return settings.zoom == "on"
    posed = np.flatnonzero(plain.scene.registered)
    if posed[-1] + int(np.diff(posed).max(initial=1)) < len(plain.scene.registered):
        return False  # Tracks are too short for so many frames, and nothing would be known of the rest.
    probe = _free_zoom(plain, config, _probing(config))
    assert probe.camera.zoom is not None
    moves = float(np.ptp(np.log(probe.camera.zoom))) >= _PROBED * settings.min_zoom
    return probe.evidence >= settings.min_zoom_evidence and moves


def _is_zoom(zoom: _Fitted, plain: _Fitted, best: _Fitted, judge: _Judge, config: Config) -> bool:
    """Tell whether the focal length changes enough, for most tracks, and explains all together better than the best."""
    settings, ratio = config.camera, zoom.camera.zoom
    if ratio is None or ratio.max() / ratio.min() - 1.0 < settings.min_zoom:
        return False
    return judge.better(zoom, plain)[1] >= settings.min_zoom_agreement and judge.better(zoom, best)[0] > 0.0


def lens_strength(camera: CameraModel, image_size: tuple[int, int], config: Config) -> Strength:
    """Return how strong the lens of a camera is."""
    displacement = camera.lens.displacement(camera.intrinsics, image_size)
    return strength_of(camera.lens, displacement, image_size, config.camera)


def is_lens(camera: CameraModel, image_size: tuple[int, int], gain: float, config: Config) -> bool:
    """Tell whether a lens bends the image enough, for what it gains: errors of a tracker mimic a weak one."""
    strength = lens_strength(camera, image_size, config)
    if strength is Strength.NO_LENS:
        return False
    return gain >= config.camera.min_evidence_unsure if strength is Strength.WEAK else gain > 0.0


def _find_lens(plain: _Fitted, judge: _Judge, config: Config) -> _Fitted:
    """Fit a radial lens, and from there once more with near and far exchanged."""
    found = _with_lens(plain, plain, judge, config)
    other = exchanged_and_refined(found.scene)
    # With a lens that is not its own the right scene explains less, but what it explains it explains better.
    if other is None or not other.noise_px < found.scene.noise_px:
        return found
    try:
        mirrored = _with_lens(replace(found, scene=other), found, judge, config)
    except SolverError:
        return found
    return mirrored if judge.better(mirrored, found)[0] > 0.0 else found


def _with_lens(found: _Fitted, rival: _Fitted, judge: _Judge, config: Config) -> _Fitted:
    """Fit one radial parameter, and a second one where there is one already or it takes energy away.

    Which tracks agree, and where they are triangulated, depends on the lens: it is fitted again until it stays, or
    until it explains much less than a rival.
    """
    settings = config.camera
    to_the_end = {"relative_decrease": settings.relative_decrease, "max_iterations": settings.max_iterations}

    def judged_anew(fitted: _Fitted) -> _Fitted:
        return replace(fitted, scene=_scene_of(fitted.camera.ideal_observations(judge.real), fitted.scene))

    first: LensModel = "RADIAL" if found.camera.lens.model == "RADIAL" else "SIMPLE_RADIAL"
    for _ in range(_LENS_ROUNDS):
        before = found.camera.lens.padded[0]
        found = judged_anew(_joint(found, first, config, to_the_end))
        if judge.better(found, rival)[0] < -_HOPELESS:
            return found
        if abs(found.camera.lens.padded[0] - before) < _LENS_STAYS:
            break
    if first == "RADIAL":
        return found
    richer = _joint(found, "RADIAL", config, to_the_end)
    return found if richer.evidence < _MIN_SECOND_EVIDENCE else judged_anew(richer)


def _joint(start: _Fitted, model: LensModel, config: Config, options: dict[str, float]) -> _Fitted:
    """Free the intrinsics, and then the parameters of a lens as well; the evidence is what the second takes away."""
    bundle = _Bundle.of(start.scene)
    camera = np.concatenate([start.scene.intrinsics, start.camera.lens.padded])
    problem, state = lens_problem(
        bundle.state, bundle.stage.problem.batches, bundle.pixels(start.camera, config), camera, model,
        start.scene.prior_intrinsics, config.bundle_adjustment, config.camera,
    )  # fmt: skip
    pixel = [] if config.bundle_adjustment.free_principal_point else [2, 3]
    solver = bundle.stage.solver.model_copy(update=options)
    unused = range(4 + len(PARAMETERS[model]), 8)
    known = range(4 if model == "SIMPLE_RADIAL" else 5, 8)
    stop = start.scene.should_stop
    state, before = _solve(replace(problem).fix(OPENCV_CAMERA, entries=[*pixel, *known]), state, solver, stop)
    state, after = _solve(replace(problem).fix(OPENCV_CAMERA, entries=[*pixel, *unused]), state, solver, stop)
    found = state[OPENCV_CAMERA][0]
    evidence = (before.final_energy - after.final_energy) / max(before.final_energies["static_reprojection"], 1e-300)
    scene = bundle.moved(start.scene, state, found[:4])
    return _Fitted(CameraModel(scene.intrinsics, Lens.of(model, found[4:])), scene, evidence)


def _find_zoom(
    camera: CameraModel, plain: _Fitted, judge: _Judge, scene: GrowingScene, real: Observations, config: Config,
    grown: Grown,
) -> _Fitted | None:  # fmt: skip
    """Grow scenes from tracks whose zoom is undone, at first that of a camera to start from, and free what is left.

    None if no scene grows, or if after a round most tracks fit the camera that does not zoom better: of a zoom that is
    one, seven tenths or more fit it then.
    """
    settings = config.camera
    to_the_end = {"relative_decrease": settings.relative_decrease, "max_iterations": _ZOOM_STEPS}
    found = None
    for _ in range(_ZOOM_ROUNDS):
        start = grown(camera.ideal_observations(real), camera.intrinsics)
        if start is None:
            return found
        part = part_of(start, settings.observations, plain.scene.registered)
        part.free_focal = scene.free_focal
        found = _free_zoom(_Fitted(camera, part), config, to_the_end)
        assert camera.zoom is not None
        assert found.camera.zoom is not None
        if settings.zoom == "auto" and judge.better(found, plain)[1] < 0.5:
            return None
        settled = float(np.ptp(np.log(found.camera.zoom / camera.zoom))) < _SETTLED
        camera = found.camera
        if settled:
            break
    return found


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


def _free_zoom(start: _Fitted, config: Config, options: dict[str, float]) -> _Fitted:
    """Free a focal length per frame, beside that which was undone."""
    bundle = _Bundle.of(start.scene)
    ideal = bundle.pixels(CameraModel(start.scene.intrinsics), config)
    problem, state = zoom_problem(
        bundle.state, bundle.stage.problem.batches, ideal, bundle.frames, config.bundle_adjustment, config.camera
    )
    before = problem.energies(state)["static_reprojection"]
    solver = bundle.stage.solver.model_copy(update=options)
    state, after = _solve(problem, state, solver, start.scene.should_stop)
    every = np.arange(len(start.scene.registered))
    zoom = np.interp(every, bundle.frames, state[ZOOM][:, 0])
    zoom = zoom if start.camera.zoom is None else zoom + np.log(start.camera.zoom)
    intrinsics = state[INTRINSICS][0].copy()
    longest = float(zoom.max())
    intrinsics[:2] *= np.exp(longest)
    evidence = (after.initial_energy - after.final_energy) / max(before, 1e-300)
    scene = bundle.moved(start.scene, state, intrinsics)
    return _Fitted(CameraModel(intrinsics, zoom=np.exp(zoom - longest)), scene, evidence)


@dataclass(frozen=True)
class _Bundle:
    """Bundle adjustment of a scene, and what is seen in it."""

    stage: Stage
    state: State
    frames: IntArray
    """(F,) that have a pose."""
    used: Observations
    """Those that take part, at ideal pixels."""
    sigma_px: float

    @classmethod
    def of(cls, scene: GrowingScene) -> _Bundle:
        stage, state, frames, _ = scene.bundle()
        return cls(stage, state, frames, scene.used()[0], scene.noise_px)

    def pixels(self, camera: CameraModel, config: Config) -> RealPixels:
        """Return the observations as a camera has them whose ideal pixels they are at."""
        used, frame = self.used, np.searchsorted(self.frames, self.used.frame)
        weight = used.weight / camera.ideal_weight(used.uv, used.frame)
        kernel = config.bundle_adjustment.reprojection_kernel
        noise = MAP.observed(self.sigma_px, weight, kernel, frame, len(self.frames))
        return RealPixels(frame, used.rows()[1], camera.real(used.uv, used.frame), noise)

    def moved(self, scene: GrowingScene, state: State, intrinsics: FloatArray) -> GrowingScene:
        """Return a scene with the cameras of a state; its points are those of before."""
        poses = scene.world_T_cam.copy()
        poses[self.frames] = state[POSE]
        return replace(scene, world_T_cam=poses, intrinsics=intrinsics.copy())


def _probing(config: Config) -> dict[str, float]:
    return {"max_iterations": config.camera.probe_steps, "initial_damping": _DAMPING, "relative_decrease": 0.0}


def _solve(
    problem: Problem, state: State, solver: SolverConfig, should_stop: Callable[[], bool]
) -> tuple[State, SolveSummary]:
    state, summary = run_stage(Stage("camera", problem, solver), state, Hooks(should_stop=should_stop))
    if summary.termination is Termination.CANCELLED:
        raise Cancelled("structure from motion stopped")
    return state, summary
