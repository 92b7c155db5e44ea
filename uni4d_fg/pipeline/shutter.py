"""The rolling shutter of a run: given, found, or none; stages then work on tracks at the time of the middle row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled, DegenerateProblemError, SolverError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.fingerprint import stage_key
from uni4d_fg.pipeline.in_progress import RunInProgress
from uni4d_fg.pipeline.lens import known_camera
from uni4d_fg.pipeline.steps import STOPPED
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.slam.lens.readout_fit import FoundReadout, ReadoutFit
from uni4d_fg.slam.lens.rolling_shutter import Readout, at_one_time
from uni4d_fg.slam.stages.acceleration import frame_interval

_STEP = "rolling_shutter"


def tracks_of_middle_rows(
    run: RunInProgress, key: str, sequence: Sequence, labelled: LabelledTracks, config: Config
) -> tuple[str, LabelledTracks]:
    """Return the key so far, and tracks at the time of the middle row, if ``camera.rolling_shutter`` says so.

    Raises:
        Cancelled: If the user interrupts.
    """
    settings = config.camera
    if not settings.has_rolling_shutter:
        run.forget(_STEP)
        return key, labelled
    key = stage_key(key, settings, config.bundle_adjustment, config.windows.calibration_sightings)
    found = run.step(_STEP, key, lambda hooks: _step(sequence, labelled, config, hooks, run.recorder))
    readout = _of_record(found)
    if readout is None:
        return key, labelled
    return key, at_one_time(labelled, readout, sequence.timestamps, sequence.image_size)


def _step(sequence: Sequence, labelled: LabelledTracks, config: Config, hooks: Hooks, run: StageRunner) -> StageRecord:
    settings = config.camera
    interval = frame_interval(sequence.timestamps) if sequence.num_frames > 1 else np.inf
    if isinstance(settings.rolling_shutter, float):
        given = Readout(settings.rolling_shutter, settings.readout_axis)
        return _record(given, {"facts": [f"{_words(given, interval)}, as given"], "solves": []})
    try:
        camera = known_camera(sequence, config)
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
    return f"no rolling shutter: the best readout {lowers}"


def _record(readout: Readout | None, summary: dict[str, Any]) -> StageRecord:
    seconds = np.nan if readout is None else readout.seconds
    by_columns = readout is not None and readout.axis == "columns"
    return StageRecord({"readout_s": np.array(seconds), "by_columns": np.array(by_columns)}, summary)


def _of_record(record: Mapping[str, npt.NDArray[Any]]) -> Readout | None:
    seconds = float(record["readout_s"])
    return None if np.isnan(seconds) else Readout(seconds, "columns" if record["by_columns"] else "rows")
