"""Fitting a zoom: bundle adjustment with the focal length of every frame as a variable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LOG_SCALE, POSE, ZOOM
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import PINHOLE
from uni4d_fg.optim.marginals import camera_marginals
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import Stage
from uni4d_fg.slam.lens.camera_model import CameraModel, of_longest_focal
from uni4d_fg.slam.lens.fit import FittedLens, HeldOut, LensFit
from uni4d_fg.slam.lens.problems import RealPixels, zoom_problem
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, bundle_adjustment_problem
from uni4d_fg.slam.stages.energy import MAP
from uni4d_fg.slam.stages.scene import Cameras, StaticScene


@dataclass(frozen=True)
class FittedZoom:
    """The end of one fit."""

    zoom: FloatArray
    """(F,) log focal length of each frame over that of the intrinsics; the longest is 0."""
    intrinsics: FloatArray
    """(4,) px, of the frame with the longest focal length."""
    evidence: float
    """Part of the reprojection energy that was lost when the zoom was set free."""
    sigma: FloatArray | None
    """(F,) standard deviation of the zoom relative to the first frame; None where nothing is known of it."""
    focal_sigma: float
    """Standard deviation of the log focal length of the first frame; NaN where nothing is known of it."""
    cameras: Cameras
    """Those of the F frames, with the intrinsics above."""


@dataclass(frozen=True)
class ZoomFit:
    """Fits zooms to the tracks that a lens is sought from."""

    fit: LensFit
    frames: np.ndarray
    """(F,) frames of the video that the tracks are of, ascending."""
    more_tracks: LabelledTracks
    """What a zoom that was found is refined on: more tracks of the same frames, on real pixels."""

    def probe(self, scene: StaticScene) -> FittedZoom:
        """Set the zoom free at the minimum of a camera that does not zoom, for a few undamped steps."""
        # The first may be refused, and what a damped one gains in its place is no reason to stop.
        steps = {
            "max_iterations": self.fit.config.camera.probe_steps,
            "initial_damping": 1e-9,
            "relative_decrease": 0.0,
        }
        return self.solve(scene, steps, "zoom probe")

    def refine(self, start: FittedZoom) -> FittedZoom:
        """Undo a zoom, run stages 1 and 2 again, and find what is left of it.

        The first solve begins at cameras that moved where they should have zoomed, and may end short of the minimum. A
        zoom is known no better than its tracks are many, and errors of 0.1 % in it cost the path as much as all others
        do.

        Raises:
            DegenerateProblemError: If the cues do not determine the cameras.
            SolverError: If a system is singular or a cue is not finite.
        """
        tracks = CameraModel(start.intrinsics, zoom=np.exp(start.zoom)).ideal_labelled(self.more_tracks)
        fit = replace(self.fit, tracks=tracks)
        left = replace(self, fit=fit).solve(fit.scene(PINHOLE, start.intrinsics))
        intrinsics, zoom = of_longest_focal(left.intrinsics, start.zoom + left.zoom)
        cameras = replace(left.cameras, intrinsics=intrinsics)
        return replace(left, zoom=zoom, intrinsics=intrinsics, evidence=start.evidence, cameras=cameras)

    def solve(self, scene: StaticScene, options: Mapping[str, float] | None = None, part: str = "zoom") -> FittedZoom:
        """Solve everything together, from a camera that does not zoom.

        Args:
            scene: Stages 1 and 2 of such a camera.
            options: Changes of the solver's settings; to the end when None.
            part: What the solve is called.

        Raises:
            SolverError: If a system is singular.
            Cancelled: If the user interrupts.
        """
        ba = self.fit.config.bundle_adjustment
        problem, state = self._problem(scene)
        solver = ba.solver.model_copy(update=dict(options or self.fit.config.camera.to_the_end))
        before = problem.energies(state)["static_reprojection"]
        stage = Stage("lens", problem, solver, part=part)
        state, after = self.fit.run(stage, state, self.fit.hooks)
        self.fit.note([after])
        gain = after.initial_energy - after.final_energy
        marginals = camera_marginals(stage.problem, state, solver)
        sigma = None if marginals is None else np.sqrt(marginals.blocks(ZOOM, len(self.frames))[:, 0, 0])
        first = state[INTRINSICS][0]
        focal = np.nan if marginals is None else np.sqrt(marginals.blocks(INTRINSICS, 1)[0, 0, 0]) / first[0]
        intrinsics, zoom = of_longest_focal(first, state[ZOOM][:, 0])
        cameras = Cameras(state[POSE], intrinsics, state[LOG_SCALE][:, 0])
        return FittedZoom(zoom, intrinsics, gain / max(before, 1e-300), sigma, float(focal), cameras)

    def agreement(self, found: FittedZoom, scene: StaticScene) -> float:
        """Return the part of the tracks that a zoom explains better than the camera that does not zoom.

        Args:
            found: Zoom and cameras.
            scene: Stages 1 and 2 of a camera that does not zoom.

        Raises:
            SolverError: If a system is singular.
        """
        return self._judge().better(self._zoomed(found, scene), FittedLens(PINHOLE, scene))

    def gain(self, found: FittedZoom, scene: StaticScene, lens: FittedLens) -> float:
        """Return the part by which a zoom lowers the energy of all tracks together below that of a lens.

        Not that of the median track: most are short, and either camera explains them.

        Raises:
            SolverError: If a system is singular.
        """
        ours, theirs = self._judge().both(self._zoomed(found, scene), lens)
        return 1.0 - float(ours.sum() / max(theirs.sum(), 1e-300))

    def _judge(self) -> HeldOut:
        return HeldOut(self.fit.config, self.more_tracks, self.fit.run, self.fit.hooks)

    @staticmethod
    def _zoomed(found: FittedZoom, scene: StaticScene) -> FittedLens:
        return FittedLens(PINHOLE, replace(scene, cameras=found.cameras), zoom=found.zoom)

    def _problem(self, scene: StaticScene) -> tuple[Problem, State]:
        """Return bundle adjustment of a scene with the zoom in place of one focal length."""
        fit, seen, plain = self.fit, scene.observations, scene.state()
        ba = fit.config.bundle_adjustment
        others = bundle_adjustment_problem(
            plain, seen, scene.noise, ba, fit.prior_intrinsics[None], Freedom(poses=True, intrinsics=True),
            acceleration=scene.acceleration,
        )  # fmt: skip
        _, row = seen.rows()
        sigma = scene.noise.reprojection_sigma_px
        noise = MAP.observed(sigma, seen.weight, ba.reprojection_kernel, seen.frame, len(self.frames))
        pixels = RealPixels(seen.frame, row, seen.uv, noise)
        return zoom_problem(plain, others.batches, pixels, self.frames, ba, fit.config.camera)
