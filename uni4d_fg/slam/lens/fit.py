"""Fitting one camera model: bundle adjustment with the lens as a variable, and the test on tracks it has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.errors import Cancelled, DegenerateProblemError, SolverError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import LANDMARK, LOG_SCALE, POSE
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.geometry.lens import PARAMETERS, Lens, LensModel
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage, StageRunner
from uni4d_fg.optim.summary import SolveSummary, Termination
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.problems import RealPixels, lens_family, lens_problem
from uni4d_fg.slam.lens.track_energy import LOST_ENERGY, robust_energies, track_energies
from uni4d_fg.slam.stages.bundle_adjustment import (
    Freedom,
    bundle_adjustment_problem,
)
from uni4d_fg.slam.stages.energy import MAP
from uni4d_fg.slam.stages.lifting import lift, mean_per_row
from uni4d_fg.slam.stages.observations import observations_of
from uni4d_fg.slam.stages.scene import Cameras, StaticScene
from uni4d_fg.slam.stages.static_scene import StaticSceneSolver
from uni4d_fg.slam.stages.structure import structure_problem


@dataclass(frozen=True)
class FittedLens:
    """The end of one fit."""

    lens: Lens
    scene: StaticScene
    """Of part of the tracks, on ideal pixels of the lens."""
    evidence: float = 0.0
    """Part of the reprojection energy that was lost when the model's parameters were set free."""
    zoom: FloatArray | None = None
    """(F,) log focal length of each frame over that of the intrinsics, not positive; None where it does not zoom."""

    @property
    def intrinsics(self) -> FloatArray:
        """(4,) px."""
        return self.scene.cameras.intrinsics

    @property
    def camera(self) -> CameraModel:
        """Intrinsics, lens and zoom."""
        return CameraModel(self.intrinsics, self.lens, None if self.zoom is None else np.exp(self.zoom))


@dataclass
class LensFit:
    """Fits camera models to the same tracks.

    Stage 1 and 2 run on ideal pixels, with the lens found so far, for cameras, landmarks and the outlier rules; then a
    joint solve moves everything, the lens included, on real pixels.
    """

    config: Config
    """See :func:`settings_of_fit`."""
    tracks: LabelledTracks
    """On real pixels."""
    prior_intrinsics: FloatArray
    """(4,) the sequence's own."""
    run: StageRunner
    hooks: Hooks | None = None
    solves: list[SolveSummary] = field(default_factory=list)

    def with_stage(self, stage: BundleAdjustmentConfig) -> LensFit:
        """Return what fits the same tracks with another bundle adjustment; their solves are noted together."""
        return replace(self, config=self.config.model_copy(update={"bundle_adjustment": stage}))

    def scene(self, lens: Lens, intrinsics: FloatArray) -> StaticScene:
        """Run stages 1 and 2 with a lens that is undone beforehand.

        Raises:
            DegenerateProblemError: If the cues do not determine the cameras.
            SolverError: If a system is singular or a cue is not finite.
        """
        solver = StaticSceneSolver(self.config, self.run, self.hooks)
        ideal = CameraModel(intrinsics, lens).ideal_labelled(self.tracks)
        found = solver.solve(ideal, intrinsics, self.prior_intrinsics, free_intrinsics=True)
        self.note(found.solves)
        return found

    def note(self, solves: list[SolveSummary]) -> None:
        """Remember solves. Raises Cancelled if the user interrupted one."""
        self.solves += solves
        if any(solve.termination is Termination.CANCELLED for solve in solves):
            raise Cancelled("stopped while the lens was sought")

    def search(self, starts: tuple[float, ...]) -> FittedLens:
        """Return the best of several k1, each undone before stages 1 and 2 run from the given intrinsics.

        Raises:
            DegenerateProblemError: If no start gives cameras.
        """
        fits = []
        for k1 in starts:
            lens = Lens("SIMPLE_RADIAL", (k1,))
            try:
                fits.append(FittedLens(lens, self.scene(lens, self.prior_intrinsics)))
            except (DegenerateProblemError, SolverError):
                continue
        if not fits:
            raise DegenerateProblemError("the lens: no start of the search gives cameras; give the camera model")
        return min(fits, key=self.energy)

    def energy(self, fit: FittedLens) -> float:
        """Return the robust reprojection energy of a fit on real pixels, dropped observations counted as lost."""
        seen = fit.scene.observations
        _, row = seen.rows()
        error = _errors(self.tracks, seen.track, seen.frame, fit, fit.scene.landmarks[row])
        sigma = self.config.bundle_adjustment.reprojection_sigma_px
        kept = robust_energies(error / sigma).sum()
        lost = int((self.tracks.weight > 0).sum()) - len(seen)
        return float(kept + lost * LOST_ENERGY)

    def refine(self, start: StaticScene, lens: Lens, model: LensModel, rounds: int = 1) -> FittedLens:
        """Solve everything together; between rounds stages 1 and 2 judge outliers anew.

        Args:
            start: A scene on ideal pixels of ``lens``.
            lens: Its lens, of the same family.
            model: The model whose parameters are set free.
            rounds: Joint solves.

        Raises:
            DegenerateProblemError: If the cues do not determine the cameras.
            SolverError: If a system is singular or a cue is not finite.
        """
        fit = self._joint(start, lens, model)
        for _ in range(1, rounds):
            fit = replace(self._joint(self.scene(fit.lens, fit.intrinsics), fit.lens, model), evidence=fit.evidence)
        return fit

    def anew(self, found: FittedLens, rounds: int) -> FittedLens:
        """Fit the model of a lens that another fit found, from stages 1 and 2 behind it on; see :meth:`refine`."""
        assert found.lens.model != "PINHOLE"
        again = self.refine(self.scene(found.lens, found.intrinsics), found.lens, found.lens.model, rounds)
        return replace(again, evidence=found.evidence)

    def probe(self, scene: StaticScene) -> float:
        """Return the evidence for one radial parameter at a pinhole's minimum, from a few steps without damping.

        The valley between focal length and distortion is narrow, but close to quadratic: an undamped step crosses it,
        where a solve to the end would creep along it.
        """
        steps = {"max_iterations": self.config.camera.probe_steps, "initial_damping": 1e-9}
        return self._joint(scene, Lens(), "SIMPLE_RADIAL", steps).evidence

    def _joint(
        self, scene: StaticScene, lens: Lens, model: LensModel, options: Mapping[str, float] | None = None
    ) -> FittedLens:
        """Solve with the parameters held, and then free: what the second gains is the evidence for them."""
        ba = self.config.bundle_adjustment
        variable, _, _ = lens_family(model)
        probe = "" if options is None else " probe"
        problem, state = self._problem(scene, lens, model)
        solver = ba.solver.model_copy(update=dict(options or self.config.camera.to_the_end))
        pixel = [] if ba.free_principal_point else [2, 3]
        held = Stage("lens", replace(problem).fix(variable, entries=[*pixel, 4, 5, 6, 7]), solver, part=f"held{probe}")
        state, before = self.run(held, state, self.hooks)
        self.note([before])
        unused = range(4 + len(PARAMETERS[model]), 8)
        free = Stage("lens", replace(problem).fix(variable, entries=[*pixel, *unused]), solver, part=f"{model}{probe}")
        state, after = self.run(free, state, self.hooks)
        self.note([after])
        camera = state[variable][0]
        cameras = Cameras(state[POSE], camera[:4], state[LOG_SCALE][:, 0])
        moved = replace(scene, cameras=cameras, landmarks=state[LANDMARK])
        gain = before.final_energy - after.final_energy
        evidence = gain / max(before.final_energies["static_reprojection"], 1e-300)
        return FittedLens(Lens.of(model, camera[4:]), moved, evidence)

    def _problem(self, scene: StaticScene, lens: Lens, model: LensModel) -> tuple[Problem, State]:
        """Return bundle adjustment of a scene with the reprojection through a lens in place of the pinhole's."""
        ba, seen, pinhole = self.config.bundle_adjustment, scene.observations, scene.state()
        others = bundle_adjustment_problem(
            pinhole, seen, scene.noise, ba, self.prior_intrinsics[None],
            Freedom(poses=True, intrinsics=False), acceleration=scene.acceleration,
        )  # fmt: skip
        _, row = seen.rows()
        real = self.tracks.tracks.uv[seen.track, seen.frame].astype(np.float64)
        # Those of stage 2, drift included, without what ideal pixels lose.
        weight = seen.weight / CameraModel(scene.cameras.intrinsics, lens).ideal_weight(seen.uv, seen.frame)
        sigma = scene.noise.reprojection_sigma_px
        noise = MAP.observed(sigma, weight, ba.reprojection_kernel, seen.frame, len(pinhole[POSE]))
        return lens_problem(
            pinhole, others.batches, RealPixels(seen.frame, row, real, noise),
            np.concatenate([scene.cameras.intrinsics, lens.padded]), model, self.prior_intrinsics, ba,
            self.config.camera,
        )  # fmt: skip


@dataclass(frozen=True)
class HeldOut:
    """Tracks that models are compared by, each triangulated anew under cameras that are held."""

    config: Config
    tracks: LabelledTracks
    """On real pixels."""
    run: StageRunner
    hooks: Hooks | None = None

    def gain(self, fit: FittedLens, other: FittedLens) -> float:
        """Return the part by which a fit explains the tracks better than another: of the median track's energy."""
        ours, theirs = self.both(fit, other)
        return float(np.median(theirs - ours) / np.median(theirs)) if len(ours) else 0.0

    def better(self, fit: FittedLens, other: FittedLens) -> float:
        """Return the part of the tracks that a fit explains better than another; half where there are none."""
        ours, theirs = self.both(fit, other)
        return float(np.mean(ours < theirs)) if len(ours) else 0.5

    def both(self, fit: FittedLens, other: FittedLens) -> tuple[FloatArray, FloatArray]:
        """Return the energies of the tracks (M,) that both of two fits see, under the one and the other."""
        ours, theirs = self.energies(fit), self.energies(other)
        known = np.isfinite(ours) & np.isfinite(theirs)
        return ours[known], theirs[known]

    def energies(self, fit: FittedLens) -> FloatArray:
        """Triangulate the tracks under frozen cameras; return each one's robust energy per observation, NaN if lost."""
        cameras, ba = fit.scene.cameras, self.config.bundle_adjustment
        ideal = fit.camera.ideal_labelled(self.tracks)
        seen = observations_of(ideal, TrackLabel.STATIC, TrackLabel.SHORT_STATIC).with_min_observations(3)
        tracks, row = seen.rows()
        landmarks = mean_per_row(lift(seen, cameras), seen.weight, row, len(tracks))
        known = np.asarray(np.isfinite(landmarks).all(axis=1))
        seen = seen.select(known[row])
        tracks, row = seen.rows()
        out = np.full(len(self.tracks.label), np.nan)
        if not len(tracks):
            return out
        state = cameras.state(landmarks[known], tracks)
        problem = structure_problem(state, seen, fit.scene.noise, ba).fix(LOG_SCALE)
        state, _ = self.run(Stage("structure", problem, ba.structure_solver, part="held out"), state, self.hooks)
        error = _errors(self.tracks, seen.track, seen.frame, fit, state[LANDMARK][row])
        out[tracks] = track_energies(error / ba.reprojection_sigma_px, row, len(tracks))
        return out


def _errors(
    tracks: LabelledTracks, track: np.ndarray, frame: np.ndarray, fit: FittedLens, points: FloatArray
) -> FloatArray:
    """Return the distance, px, of real pixels of observations (N,) from where points (N, 3) appear."""
    x = world_to_camera(fit.scene.cameras.world_T_cam[frame], points)
    real = fit.camera.real(np.asarray(project(fit.intrinsics, x)), frame)
    return np.asarray(np.linalg.norm(real - tracks.tracks.uv[track, frame], axis=1))
