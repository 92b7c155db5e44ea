"""The camera model of a run: given, found, or the pinhole; stages then work on ideal pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled, DegenerateProblemError, SolverError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import PARAMETERS, PINHOLE, Lens
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.steps import STOPPED
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.slam.lens.calibration import LensCalibration, calibrate_lens
from uni4d_fg.slam.lens.tracks import ideal_tracks


@dataclass(frozen=True)
class CameraModel:
    """What stages take for known of the camera."""

    lens: Lens
    intrinsics: FloatArray
    """(4,) px."""

    def apply(
        self, sequence: Sequence, labelled: LabelledTracks, config: Config
    ) -> tuple[Sequence, LabelledTracks, Config]:
        """Return what the stages solve: a pinhole's sequence and tracks; intrinsics are held, as the lens is theirs."""
        if self.lens.is_pinhole:
            return sequence, labelled, config
        held = config.input.model_copy(update={"intrinsics": "fixed"})
        return (
            replace(sequence, intrinsics=self.intrinsics, lens=PINHOLE),
            ideal_tracks(labelled, self.intrinsics, self.lens),
            config.model_copy(update={"input": held}),
        )


def is_sought(sequence: Sequence, config: Config) -> bool:
    """Return whether the lens is estimated.

    That needs the likelihood of energy 'map', Levenberg-Marquardt, and poses and intrinsics that may move. A lens that
    came with the sequence is taken as it is, unless a model is asked for.
    """
    if config.camera.model == "auto" and not sequence.lens.is_pinhole:
        return False
    if config.camera.model == "pinhole" or config.input.intrinsics == "fixed" or config.input.poses != "estimate":
        return False
    return config.energy == "map" and config.solver == "lm" and config.bundle_adjustment.depth_prior


def known_camera(sequence: Sequence, config: Config) -> CameraModel:
    """Return the camera of a sequence whose lens is not estimated."""
    lens = PINHOLE if config.camera.model == "pinhole" else sequence.lens
    return CameraModel(lens, sequence.intrinsics)


def lens_step(
    sequence: Sequence, labelled: LabelledTracks, config: Config, hooks: Hooks, run: StageRunner
) -> StageRecord:
    """Find the lens; where 'auto' cannot, the pinhole is kept and the summary says why.

    Raises:
        DegenerateProblemError: If a model was asked for and the cues do not determine the cameras.
        SolverError: If a model was asked for and a system is singular.
        Cancelled: If the user interrupts.
    """
    try:
        found = calibrate_lens(labelled, sequence.image_size, sequence.intrinsics, config, sequence.lens, hooks, run)
    except (DegenerateProblemError, SolverError) as error:
        if config.camera.model != "auto":
            raise
        found = LensCalibration(PINHOLE, sequence.intrinsics, note=f"no distortion was sought: {error}")
    except Cancelled as error:
        raise Cancelled(STOPPED) from error
    arrays = {
        "model": np.array([list(PARAMETERS).index(found.lens.model)]),
        "parameters": found.lens.padded,
        "intrinsics": found.intrinsics,
    }
    summary: dict[str, Any] = {
        "solves": [solve_dict(solve) for solve in found.solves],
        "facts": found.facts(),
        "camera_model": found.lens.model,
        "candidates": [
            {
                "camera_model": c.lens.model,
                "parameters": list(c.lens.parameters),
                "intrinsics": c.intrinsics.tolist(),
                "evidence": c.evidence,
                "held_out_gain": c.held_out_gain,
                "displacement_px": c.displacement_px,
            }
            for c in found.candidates
        ],
    }
    return StageRecord(arrays, summary)


def found_camera(arrays: Mapping[str, npt.NDArray[Any]]) -> CameraModel:
    """Return the camera of a record of :func:`lens_step`."""
    model = list(PARAMETERS)[int(arrays["model"][0])]
    return CameraModel(Lens.of(model, arrays["parameters"]), arrays["intrinsics"])
