"""Cameras fitted to the tracks of a grown scene: with a lens, with a focal length per frame, and which fits better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.config.solver import SolverConfig
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.judging import energy_of_cameras
from uni4d_fg.cues.structure.trimming import trim
from uni4d_fg.errors import Cancelled
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, OPENCV_CAMERA, POSE, ZOOM
from uni4d_fg.geometry.lens import PARAMETERS, Lens, LensModel
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.marginals import camera_marginals
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, run_stage
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.problems import RealPixels, lens_problem, zoom_problem
from uni4d_fg.slam.lens.track_energy import track_energies
from uni4d_fg.slam.stages.energy import MAP
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.windows.plan import TrackSpans, calibration_frames

_DAMPING = 1e-6
"""Of the probe: the scale of a scene is held by a weak prior only, so that steps are not quite undamped."""
_LOOSER = 10
"""Times the relative decrease of a joint solve at which cameras that are compared are solved: k1 changes by 0.00003, a
focal length by 0.002 %."""
_SETTLING = 2
"""So many times more steps are taken without a zoom before the probe: what they leave is 1.5 % of the energy after as
many, 0.9 % after twice as many."""
_MAX_FRAMES = 120
"""Frames that cameras are compared on, at most: a focal length per frame makes the system of the cameras dense."""
_SIGHTINGS = 4
"""In so many of them an average track is seen at least."""


@dataclass(frozen=True)
class Fitted:
    """A camera that was fitted, and the poses that go with it."""

    camera: CameraModel
    scene: GrowingScene
    evidence: float = 0.0
    """Part of the reprojection energy that setting the camera free took away."""


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
    return scene_of(seen.select(seen.thinned(observations)), replace(scene, registered=scene.registered & chosen))


def scene_of(ideal: Observations, cameras: GrowingScene) -> GrowingScene:
    """Return what the cameras of a scene see of other observations, trimmed."""
    scene = cameras.seeing(ideal)
    trim(scene)
    scene.measure_noise()
    return scene


@dataclass(frozen=True)
class TrackJudge:
    """Compares cameras by tracks that are triangulated anew."""

    real: Observations
    """As the images show them."""
    sigma_px: float

    def energies(self, fitted: Fitted) -> FloatArray:
        """Return the mean robust energy (K,) of each track on real pixels; NaN where its rays are too parallel."""
        tracks, _ = self.real.rows()
        scene = fitted.scene.seeing(fitted.camera.ideal_observations(self.real))
        seen = scene.observations
        size = fitted.camera.ideal_weight(seen.uv, seen.frame)
        error = scene.errors() * np.sqrt(size) / self.sigma_px
        known = np.isin(tracks, seen.track[np.isfinite(scene.position[scene.row, 0])])
        energy = track_energies(error, np.searchsorted(tracks, seen.track), len(tracks))
        return np.where(known, energy, np.nan)

    def anew(self, fitted: Fitted) -> Fitted:
        """Return what was fitted with all tracks triangulated and judged anew, by its camera."""
        return replace(fitted, scene=scene_of(fitted.camera.ideal_observations(self.real), fitted.scene))

    def cost(self, fitted: Fitted) -> float:
        """Return the mean robust energy of all observations, those of tracks whose rays are parallel as well."""
        ideal = fitted.camera.ideal_observations(self.real)
        size = fitted.camera.ideal_weight(ideal.uv, ideal.frame)
        return energy_of_cameras(fitted.scene, ideal, self.sigma_px / np.sqrt(size))

    def better(self, fitted: Fitted, rival: Fitted) -> tuple[float, float]:
        """Return by which part a camera lowers the energy of the tracks that both have a point of, and of how many."""
        ours, theirs = self.energies(fitted), self.energies(rival)
        known = np.isfinite(ours) & np.isfinite(theirs)
        if not known.any():
            return 0.0, 0.0
        ours, theirs = ours[known], theirs[known]
        return 1.0 - float(ours.sum() / max(theirs.sum(), 1e-300)), float(np.mean(ours < theirs))


def fit_lens(
    start: Fitted, model: LensModel, config: Config, options: dict[str, float], *, settled: bool = False
) -> Fitted:
    """Free the intrinsics and the parameters of a lens.

    Args:
        start: Cameras to begin with.
        model: Of the lens.
        config: What the solve reads.
        options: Changes of the solver's settings.
        settled: First solve with the lens as it is, so that the evidence is of its parameters alone.
    """
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
    if settled:
        state, _ = _solve(replace(problem).fix(OPENCV_CAMERA, entries=[*pixel, *known]), state, solver, stop)
    state, summary = _solve(replace(problem).fix(OPENCV_CAMERA, entries=[*pixel, *unused]), state, solver, stop)
    found, before = state[OPENCV_CAMERA][0], summary.initial_energies["static_reprojection"]
    evidence = (summary.initial_energy - summary.final_energy) / max(before, 1e-300)
    scene = bundle.moved(start.scene, state, found[:4])
    return Fitted(CameraModel(scene.intrinsics, Lens.of(model, found[4:])), scene, evidence)


def fit_zoom(start: Fitted, config: Config, options: dict[str, float], *, settled: bool = False) -> Fitted:
    """Free a focal length per frame, beside that which was undone.

    Args:
        start: Cameras to begin with.
        config: What the solve reads.
        options: Changes of the solver's settings.
        settled: First solve without it, so that the evidence is of the zoom alone: what two steps take away of a scene
            that is not at its minimum yet is up to a sixth of the energy.
    """
    bundle = _Bundle.of(start.scene)
    problem, state = bundle.with_zoom(config)
    solver = bundle.stage.solver.model_copy(update=options)
    if settled:
        longer = solver.model_copy(update={"max_iterations": _SETTLING * solver.max_iterations})
        state, _ = _solve(replace(problem).fix(ZOOM), state, longer, start.scene.should_stop)
    before = problem.energies(state)["static_reprojection"]
    state, after = _solve(problem, state, solver, start.scene.should_stop)
    every = np.arange(len(start.scene.registered))
    zoom = np.interp(every, bundle.frames, state[ZOOM][:, 0])
    zoom = zoom if start.camera.zoom is None else zoom + np.log(start.camera.zoom)
    camera = CameraModel.of_log_zoom(state[INTRINSICS][0], zoom)
    evidence = (after.initial_energy - after.final_energy) / max(before, 1e-300)
    return Fitted(camera, bundle.moved(start.scene, state, camera.intrinsics), evidence)


def zoom_freedom(scene: GrowingScene, config: Config) -> float:
    """Return by how much the focal length of some frame is less certain than that of a zoom whose ratios are known.

    Args:
        scene: Refined at ideal pixels, from which the zoom is undone.
        config: What the solve reads.

    Raises:
        SolverError: If the system cannot be solved.
    """
    bundle = _Bundle.of(part_of(scene, config.camera.observations, np.ones_like(scene.registered)))
    problem, state = bundle.with_zoom(config)
    known = camera_marginals(replace(problem).fix(ZOOM), state, bundle.stage.solver)
    free = camera_marginals(problem, state, bundle.stage.solver)
    if known is None or free is None:
        return 1.0
    first, held = (float(np.sqrt(one.blocks(INTRINSICS, 1)[0, 0, 0])) for one in (free, known))
    others = np.sqrt(free.blocks(ZOOM, len(bundle.frames))[:, 0, 0])
    focal = float(state[INTRINSICS][0, 0])
    return max(1.0, float(np.hypot(first / focal, others.max())) * focal / held)


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

    def with_zoom(self, config: Config) -> tuple[Problem, State]:
        """Return the same with a focal length per frame, beside a zoom that was undone."""
        pixels = self.pixels(CameraModel(self.state[INTRINSICS][0]), config)
        return zoom_problem(
            self.state, self.stage.problem.batches, pixels, self.frames, config.bundle_adjustment, config.camera
        )

    def moved(self, scene: GrowingScene, state: State, intrinsics: FloatArray) -> GrowingScene:
        """Return a scene with the cameras of a state; its points are those of before."""
        poses = scene.world_T_cam.copy()
        poses[self.frames] = state[POSE]
        return replace(scene, world_T_cam=poses, intrinsics=intrinsics.copy())


def comparing(config: Config, max_iterations: int) -> dict[str, float]:
    """Return the options of a solve that cameras are compared after.

    What decides between them is a thousandth of the energy and more, and a camera that the tracks do not ask for is in
    a valley along which a hundred more steps lower it by less than a twenty-thousandth.
    """
    return {"relative_decrease": _LOOSER * config.camera.relative_decrease, "max_iterations": max_iterations}


def probing(config: Config) -> dict[str, float]:
    """Return the options of a few steps with little damping that leave a minimum which is none of the right camera."""
    return {"max_iterations": config.camera.probe_steps, "initial_damping": _DAMPING, "relative_decrease": 0.0}


def _solve(
    problem: Problem, state: State, solver: SolverConfig, should_stop: Callable[[], bool]
) -> tuple[State, SolveSummary]:
    state, summary = run_stage(Stage("camera", problem, solver), state, Hooks(should_stop=should_stop))
    if summary.termination is Termination.CANCELLED:
        raise Cancelled("structure from motion stopped")
    return state, summary
