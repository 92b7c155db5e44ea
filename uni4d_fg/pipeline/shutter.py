"""The rolling shutter of a run: given, found, or none."""

from __future__ import annotations

from typing import Any

import numpy as np

from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled, DegenerateProblemError, SolverError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.fingerprint import stage_key
from uni4d_fg.pipeline.in_progress import RunInProgress
from uni4d_fg.pipeline.lens import is_readout_sought, is_sought, known_camera
from uni4d_fg.pipeline.steps import STOPPED
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.readout_fit import FoundReadout, ReadoutFit
from uni4d_fg.slam.lens.rolling_shutter import Readout, readout_of_array, readout_to_array
from uni4d_fg.slam.stages.acceleration import frame_interval

_STEP = "rolling_shutter"


def readout_step(
    run: RunInProgress, key: str, sequence: Sequence, labelled: LabelledTracks, config: Config
) -> tuple[str, Readout | None]:
    """Return the key so far, and the readout that ``camera.rolling_shutter`` gives, or that is found with a pinhole.

    Where a lens is sought, it is found once more with that: see :mod:`uni4d_fg.slam.lens.shutter_calibration`.

    Raises:
        Cancelled: If the user interrupts.
    """
    settings = config.camera
    if settings.given_readout is None and not is_readout_sought(config):
        run.forget(_STEP)
        return key, None
    key = stage_key(key, settings, config.bundle_adjustment, config.windows.calibration_sightings)
    found = run.step(_STEP, key, lambda hooks: _step(sequence, labelled, config, hooks, run.recorder))
    return key, readout_of_array(found["readout"])


def _step(sequence: Sequence, labelled: LabelledTracks, config: Config, hooks: Hooks, run: StageRunner) -> StageRecord:
    settings = config.camera
    interval = frame_interval(sequence.timestamps) if sequence.num_frames > 1 else np.inf
    if settings.given_readout is not None:
        given = Readout(settings.given_readout, settings.readout_axis)
        return _record(given, {"facts": [f"{_words(given, interval)}, as given"], "solves": []})
    try:
        # A lens that is asked for is not known yet.
        camera = CameraModel(sequence.intrinsics) if is_sought(sequence, config) else known_camera(sequence, config)
        found = ReadoutFit(labelled, sequence.timestamps, sequence.image_size, camera, config, run, hooks).find()
    except (DegenerateProblemError, SolverError) as error:
        return _record(None, {"facts": [f"no rolling shutter was sought: {error}"], "solves": []})
    except Cancelled as error:
        raise Cancelled(STOPPED) from error
    summary: dict[str, Any] = {
        "facts": [_finding(found, interval)],
        "evidence": found.evidence,
        "readout_s": None if found.best is None else found.best.seconds,
        "axis": None if found.best is None else found.best.axis,
        "solves": [solve_dict(solve) for solve in found.solves],
    }
    return _record(found.readout, summary)


def _words(readout: Readout, interval: float) -> str:
    """Say how an image is read; ``interval`` is the time between two, s."""
    part = f" ({abs(readout.seconds) / interval:.2f} of the time between two frames)" if np.isfinite(interval) else ""
    order = "" if readout.seconds > 0 else ", the last one first"
    return f"rolling shutter: {readout.axis} are read in {1000 * abs(readout.seconds):.1f} ms{part}{order}"


def _finding(found: FoundReadout, interval: float) -> str:
    lowers = f"lowers the reprojection energy by {100 * found.evidence:.2f} %"
    if found.readout is not None:
        return f"{_words(found.readout, interval)}; that {lowers}"
    if found.is_asked_for:
        return f"no rolling shutter: tracks fit best if reading takes all the time between two frames, which {lowers}"
    return f"no rolling shutter: the best readout {lowers}"


def _record(readout: Readout | None, summary: dict[str, Any]) -> StageRecord:
    return StageRecord({"readout": readout_to_array(readout)}, summary)
