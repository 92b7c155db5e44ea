"""Whether the images of a video are read row by row, and how fast, from its tracks.

Bundle adjustment of part of the static tracks, moved to where they were at one time
(:mod:`uni4d_fg.slam.lens.rolling_shutter`), is repeated for several times of readout
(:mod:`uni4d_fg.slam.lens.readout_search`); the part of the reprojection energy that goes away at its minimum is the
evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.factors.state import State
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import PINHOLE
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import Stage, StageRunner, run_stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.fit import LensFit
from uni4d_fg.slam.lens.readout_search import BELIEVED, LONGEST, least_readout
from uni4d_fg.slam.lens.rolling_shutter import Axis, Readout, at_one_time
from uni4d_fg.slam.lens.sample import EXACT_PX, CalibrationSample
from uni4d_fg.slam.stages.acceleration import frame_interval
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, bundle_adjustment_problem, near_the_minimum
from uni4d_fg.slam.stages.scene import StaticScene


@dataclass(frozen=True)
class FoundReadout:
    """What was found."""

    best: Readout | None = None
    """The one that explains the tracks best; None for none, or where none was sought."""
    evidence: float = 0.0
    """Part of the reprojection energy that goes away with it."""
    is_asked_for: bool = False
    """Whether that is enough."""
    is_longest: bool = False
    """Whether it takes all of the time between two frames, or next to it. No shutter is as long: something else makes
    tracks ask for it, in part."""
    solves: list[SolveSummary] = field(default_factory=list)

    @property
    def readout(self) -> Readout | None:
        """The one to solve cameras with; None where the tracks do not ask for one, or for one that cannot be."""
        return self.best if self.is_asked_for and not self.is_longest else None


class ReadoutFit:
    """Compares times of readout on part of the tracks, with outliers as they are judged without one."""

    def __init__(
        self,
        labelled: LabelledTracks,
        timestamps: FloatArray,
        image_size: tuple[int, int],
        camera: CameraModel,
        config: Config,
        run: StageRunner = run_stage,
        hooks: Hooks | None = None,
    ):
        """Choose the tracks and find cameras with them as they are.

        Args:
            labelled: All tracks, on real pixels.
            timestamps: (T,) s.
            image_size: (height, width), px.
            camera: Intrinsics, and a lens and a zoom that are known.
            config: The camera's section and those of stages 1 and 2.
            run: What solves each declared stage.
            hooks: Progress and cancellation.

        Raises:
            DegenerateProblemError: If the cues do not determine the cameras.
            SolverError: If a system is singular or a cue is not finite.
        """
        self.timestamps, self.image_size, self.camera = timestamps, image_size, camera
        self.sample = CalibrationSample.of(labelled, config)
        self.tracks = self.sample.tracks(config.camera.observations)
        settings = self.sample.settings(config)
        stage = settings.bundle_adjustment.model_copy(update={"first_depth_sigma": None})
        self.fit = LensFit(settings, self._at(None), camera.intrinsics, run, hooks).with_stage(stage)
        self.scene: StaticScene = self.fit.scene(PINHOLE, camera.intrinsics)
        self._state: State = self.scene.state()
        self._solved: dict[Readout | None, SolveSummary] = {}

    def find(self) -> FoundReadout:
        """Return the readout that explains the tracks best, and whether they ask for it."""
        if self.scene.noise.measured_px < EXACT_PX or len(self.timestamps) < 3:
            return FoundReadout(solves=self.fit.solves)
        interval = frame_interval(self.timestamps)
        best = min((self._along(axis, interval) for axis in ("rows", "columns")), key=self.energy)
        reprojection = self._solved[None].final_energies["static_reprojection"]
        evidence = (self.energy(None) - self.energy(best)) / max(reprojection, 1e-300)
        asked = best is not None and evidence >= self.fit.config.camera.min_readout_evidence
        longest = best is not None and abs(best.seconds) >= BELIEVED * interval
        if best is not None and longest:
            best = Readout(float(np.copysign(LONGEST * interval, best.seconds)), best.axis)
        return FoundReadout(best, evidence, asked, longest, self.fit.solves)

    def energy(self, readout: Readout | None) -> float:
        """Return the energy that bundle adjustment ends at with a readout, from where the last one ended."""
        if readout not in self._solved:
            seen = self.scene.observations
            uv = self._at(readout).tracks.uv[seen.track, seen.frame].astype(np.float64)
            ba = self.fit.config.bundle_adjustment
            problem = bundle_adjustment_problem(
                self._state, replace(seen, uv=uv), self.scene.noise, ba, self.camera.intrinsics[None],
                Freedom(poses=True, intrinsics=True), acceleration=self.scene.acceleration,
            )  # fmt: skip
            name = "none" if readout is None else f"{readout.axis} {1000 * readout.seconds:.1f} ms"
            stage = Stage("lens", problem, near_the_minimum(ba.solver), part=f"readout {name}")
            self._state, summary = self.fit.run(stage, self._state, self.fit.hooks)
            self.fit.note([summary])
            self._solved[readout] = summary
        return self._solved[readout].final_energy

    def _along(self, axis: Axis, interval: float) -> Readout | None:
        """Return the best readout along an axis."""

        def readout(part: float) -> Readout | None:
            return Readout(part * interval, axis) if part else None

        return readout(least_readout(lambda part: self.energy(readout(part))))

    def _at(self, readout: Readout | None) -> LabelledTracks:
        """Return the chosen tracks in the chosen frames, with a readout undone, and a lens and a zoom if known."""
        labelled = at_one_time(self.tracks, readout, self.timestamps, self.image_size)
        return self.sample.cut(self.camera.ideal_labelled(labelled))
