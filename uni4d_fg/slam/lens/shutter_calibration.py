"""The lens of a camera that may read its rows one after the other.

A rolling shutter moves what is seen by up to a frame's motion, more toward the first and last rows, which a lens or a
zoom makes up for in part. Where one was found and the tracks ask for a readout as well, it is found once more from
tracks at the time of the middle row. Stages that solve on tracks as they are (``camera.rolling_shutter=off``) hold what
was found: with it free, the shutter would move the focal length again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.errors import DegenerateProblemError, SolverError
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner, run_stage
from uni4d_fg.slam.lens.calibration import LensCalibration, calibrate_lens
from uni4d_fg.slam.lens.readout_fit import ReadoutFit
from uni4d_fg.slam.lens.rolling_shutter import at_one_time
from uni4d_fg.slam.stages.acceleration import frame_interval

_UNCERTAIN, _MOST = 0.5, 0.03
"""Standard deviation of the log of the focal length, as a part of what the shutter moved it by, and at most. That is 4
to 14 % on the recordings through k1 of -0.12 and -0.25, which then are 0 to 4.5 % off."""


def calibrate_with_shutter(
    labelled: LabelledTracks,
    timestamps: FloatArray,
    image_size: tuple[int, int],
    intrinsics: FloatArray,
    config: Config,
    given: Lens | None = None,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> LensCalibration:
    """Find the lens or zoom and the intrinsics of a video, without what a rolling shutter does to them.

    Args:
        labelled: All tracks, on real pixels; at the time of the middle row already where ``config.camera`` has a
            rolling shutter.
        timestamps: (T,) s, increasing.
        image_size: (height, width), px.
        intrinsics: (4,) the sequence's own, px.
        config: The camera's section and those of stages 1 and 2.
        given: Lens to start from.
        hooks: Progress and cancellation.
        run: What solves each declared stage.

    Raises:
        DegenerateProblemError: If the cues do not determine the cameras.
        SolverError: If a system is singular or a cue is not finite.
        Cancelled: If the user interrupts.
    """

    def calibrated(tracks: LabelledTracks) -> LensCalibration:
        return calibrate_lens(tracks, image_size, intrinsics, config, given, hooks, run)

    found = calibrated(labelled)
    if found.camera.is_plain or config.camera.has_rolling_shutter:
        return found
    try:
        shutter = ReadoutFit(labelled, timestamps, image_size, found.camera, config, run, hooks).find()
        if shutter.readout is None:
            return replace(found, solves=found.solves + shutter.solves)
        again = calibrated(at_one_time(labelled, shutter.readout, timestamps, image_size))
    except (DegenerateProblemError, SolverError):
        return found
    part = abs(shutter.readout.seconds) / frame_interval(timestamps)
    said = (
        f"found from tracks at the time of the middle row: reading {shutter.readout.axis} takes {part:.2f} of the time "
        f"between two frames (camera.rolling_shutter=auto solves the cameras on them, too)"
    )
    note = f"{again.note}; {said}" if again.note else said
    sigma = None
    if not again.lens.is_pinhole:
        moved = abs(float(np.log(again.intrinsics[0] / found.intrinsics[0])))
        sigma = min(_UNCERTAIN * moved, _MOST)
    return replace(again, solves=found.solves + shutter.solves + again.solves, note=note, focal_sigma=sigma)
