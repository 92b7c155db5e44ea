"""The lens of a camera that may read its rows one after the other.

A rolling shutter moves what is seen by up to a frame's motion, more toward the first and last rows, which a lens or a
zoom makes up for in part; and the other way round, a lens hides a readout: that found with a pinhole is 0.3 of the time
between two frames too short behind k1 = -0.25, or none. So a lens or zoom is sought on tracks at the time of the middle
row, the readout once more with it, and the lens once more where that is another one, until they agree.

Where the tracks ask for the longest readout that there is (:class:`~uni4d_fg.slam.lens.readout_fit.FoundReadout`), the
lens is that of tracks at the time of the middle row all the same, but the stages solve on tracks as they are. They hold
what was found: with it free, what is left of the shutter would move the focal length again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

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
from uni4d_fg.slam.lens.rolling_shutter import Readout, at_one_time
from uni4d_fg.slam.stages.acceleration import frame_interval

_UNCERTAIN, _MOST = 0.5, 0.03
"""Standard deviation of the log of the focal length, as a part of what the shutter moved it by, and at most. That is 4
to 14 % on the recordings through k1 of -0.12 and -0.25, which then are 0 to 4.5 % off."""
_ROUNDS = 2
"""A zoom that is none hides a part of the readout from the first."""
_ALIKE = 0.03
"""Readouts that differ by less, in times between two frames, are taken for the same."""


def calibrate_with_shutter(
    labelled: LabelledTracks,
    timestamps: FloatArray,
    image_size: tuple[int, int],
    intrinsics: FloatArray,
    config: Config,
    readout: Readout | None = None,
    given: Lens | None = None,
    hooks: Hooks | None = None,
    run: StageRunner = run_stage,
) -> LensCalibration:
    """Find the lens or zoom and the intrinsics of a video, without what a rolling shutter does to them.

    Args:
        labelled: All tracks, on real pixels, as they are seen.
        timestamps: (T,) s, increasing.
        image_size: (height, width), px.
        intrinsics: (4,) the sequence's own, px.
        config: The camera's section and those of stages 1 and 2.
        readout: Given, or found with a pinhole; None for none.
        given: Lens to start from.
        hooks: Progress and cancellation.
        run: What solves each declared stage.

    Raises:
        DegenerateProblemError: If the cues do not determine the cameras.
        SolverError: If a system is singular or a cue is not finite.
        Cancelled: If the user interrupts.
    """

    def calibrated(undone: Readout | None) -> LensCalibration:
        tracks = at_one_time(labelled, undone, timestamps, image_size)
        return replace(calibrate_lens(tracks, image_size, intrinsics, config, given, hooks, run), readout=undone)

    first = found = calibrated(readout)
    interval, is_longest = frame_interval(timestamps), False
    for _ in range(_ROUNDS if config.camera.rolling_shutter == "auto" else 0):
        if found.camera.is_plain:
            break
        try:
            shutter = ReadoutFit(labelled, timestamps, image_size, found.camera, config, run, hooks).find()
            undone = shutter.best if shutter.is_asked_for else None
            again = found if _alike(undone, found.readout, interval) else calibrated(undone)
        except (DegenerateProblemError, SolverError):  # what was found before is no worse for it
            break
        if again is found:
            found = replace(found, solves=found.solves + shutter.solves)
            break
        found = replace(again, solves=found.solves + shutter.solves + again.solves)
        is_longest = shutter.is_asked_for and shutter.is_longest
    if not is_longest:
        return found
    return _held(found, first.intrinsics[0] if readout is None else None)


def _alike(one: Readout | None, other: Readout | None, interval: float) -> bool:
    """Tell whether a lens found with one of two readouts is that found with the other."""
    if one is None or other is None:
        return one is other
    return one.axis == other.axis and abs(one.seconds - other.seconds) < _ALIKE * interval


def _held(found: LensCalibration, focal_before: float | None) -> LensCalibration:
    """Return what stages are to hold that solve on tracks as they are; of these the focal length was another, px."""
    said = (
        f"found from tracks at the time of the middle row, as if reading {cast(Readout, found.readout).axis} took all "
        f"the time between two frames; cameras are solved on tracks as they are"
    )
    sigma = None
    if not found.lens.is_pinhole:
        moved = np.inf if focal_before is None else abs(float(np.log(found.intrinsics[0] / focal_before)))
        sigma = min(_UNCERTAIN * moved, _MOST)
    note = f"{found.note}; {said}" if found.note else said
    return replace(found, note=note, focal_sigma=sigma, readout=None)
