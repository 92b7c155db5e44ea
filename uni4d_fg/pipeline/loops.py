"""Loop closing in a run: whether it is searched for, and what the summary says of it."""

from __future__ import annotations

from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline.lens import CameraModel
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.slam.loops.closing import LoopClosing


def loop_closing(sequence: Sequence, camera: CameraModel, config: Config) -> LoopClosing | None:
    """Return the search for loops in a sequence as stages solve it; None where there is none.

    Closures need sigmas to be weighed by (energy 'map'), a solver that takes them, cameras that move and one focal
    length.
    """
    may = config.energy == "map" and config.solver == "lm" and config.input.poses != "fixed" and camera.zoom is None
    if config.loops.enabled == "off" or not may or sequence.num_frames <= config.loops.min_gap:
        return None
    return LoopClosing(sequence, camera.lens, config.loops)


def with_loops(loops: LoopClosing | None, record: StageRecord) -> StageRecord:
    """Return the record of bundle adjustment with what became of loops in its summary."""
    if loops is None or not (loops.links or loops.let_go):
        return record
    summary = dict(record.summary)
    summary["facts"] = [*summary.get("facts", []), *loops.facts()]
    summary["warnings"] = [*summary.get("warnings", []), *loops.warnings()]
    summary["loops"] = {
        "closed": [[one.first, one.second, one.inliers] for one in loops.links or []],
        "let_go": [[one.first, one.second, one.inliers] for one in loops.let_go],
    }
    return StageRecord(record.arrays, summary)
