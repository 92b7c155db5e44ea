"""Loop closing in a run: whether it is searched for, and what the summary says of it."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, LOG_SCALE, POSE
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.pipeline.lens import known_camera
from uni4d_fg.pipeline.store import StageRecord
from uni4d_fg.slam.incremental.results import Finished
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.loops.closing import LoopClosing
from uni4d_fg.slam.loops.pose_graph import close_path


def loop_closing(sequence: Sequence, camera: CameraModel, config: Config) -> LoopClosing | None:
    """Return the search for loops in a sequence as stages solve it; None where there is none.

    Closures need sigmas to be weighed by (energy 'map'), a solver that takes them, cameras that move and one focal
    length.
    """
    may = config.energy == "map" and config.solver == "lm" and config.input.poses != "fixed" and camera.zoom is None
    if config.loops.enabled == "off" or not may or sequence.num_frames <= config.loops.min_gap:
        return None
    return LoopClosing(sequence, camera.lens, config.loops)


def close_stream(
    path: Finished, intrinsics: FloatArray, sequence: Sequence, config: Config
) -> tuple[Finished, LoopClosing | None]:
    """Return what a stream has left, with its loops closed, and the search; the path itself where there is no loop.

    Args:
        path: All frames of the sequence.
        intrinsics: (4,) px, as the stream found them.
        sequence: Its images, depth and masks are read again where the camera may have come back.
        config: What is compared and believed.
    """
    closing = loop_closing(sequence, known_camera(sequence, config), config)
    frames = [] if closing is None else list(path.frames())
    # A stream takes no frame twice: numbers are those of the sequence only if it has taken all.
    if closing is None or len(frames) != sequence.num_frames:
        return path, None
    poses = np.stack([frame.world_T_cam for frame in frames])
    log_scale = np.array([[frame.log_scale] for frame in frames])
    closing.search(State({POSE: poses, INTRINSICS: intrinsics[None], LOG_SCALE: log_scale}))
    closed = close_path(path, poses, np.stack([frame.covariance for frame in frames]), closing)
    return (path if closed is None else closed), closing


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
