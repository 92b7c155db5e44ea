"""Stages 1 to 3 in windows: each window's record is kept, and the joined ones look like those of one graph."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.counted import counted
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.optim.added_factors import AddingRunner
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.fingerprint import stage_key
from uni4d_fg.pipeline.rigid import NOT_IN_WINDOWS
from uni4d_fg.pipeline.steps import Arrays, bundle_summary, given_poses, nonrigid_step, stop_if_cancelled
from uni4d_fg.pipeline.store import StageRecord, StageStore
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.progress import Reporter
from uni4d_fg.slam.stages.bundle_adjustment import hold_metric_scale
from uni4d_fg.slam.stages.scene import Cameras, unknown_covariances
from uni4d_fg.slam.windows.added_terms import added_terms
from uni4d_fg.slam.windows.join import Joined, chain, join
from uni4d_fg.slam.windows.motion import join_motion
from uni4d_fg.slam.windows.numbered import NumberedRunner
from uni4d_fg.slam.windows.plan import TrackSpans, Window, blend_weight, tracks_in
from uni4d_fg.slam.windows.scene import (
    WindowLandmarks,
    WindowScene,
    calibrate,
    finish,
    information,
    owned,
    place,
    solve_scene,
)

_STOPPED = "stopped; finished windows are kept, --resume continues from them"


@dataclass(frozen=True)
class WindowedRun:
    """What the steps of a windowed run share."""

    sequence: Sequence
    labelled: LabelledTracks
    windows: list[Window]
    config: Config
    store: StageStore
    """Of the windows' own records."""
    resume: bool
    run: StageRunner
    reporter: Reporter
    should_stop: Callable[[], bool]

    def record(self, name: str, window: Window, key: str, compute: Callable[[], StageRecord]) -> StageRecord:
        """Return one window's record: the stored one of the same key when resuming, else computed and stored.

        The last window is always solved: its factor graph is that of the step, and not part of the record.

        Raises:
            Cancelled: If the user interrupts; finished windows are kept.
            OutputError: If it cannot be written.
        """
        file = f"{name}_{window.start:06d}"
        found = self.store.load(file, key) if self.resume and window is not self.windows[-1] else None
        if found is None:
            self.check_cancelled()
            found = compute()
            self.store.save(file, key, found)
        self.reporter.advance(window.stop, f"frames {window} of {self.windows[-1].stop}")
        return found

    def check_cancelled(self) -> None:
        """Stop if the user asked for it.

        Raises:
            Cancelled: Then.
        """
        if self.should_stop():
            raise Cancelled("stopped; finished windows are kept, --resume continues from them")


def scene_step(windowed: WindowedRun, key: str, hooks: Hooks) -> StageRecord:
    """Solve stages 1 and 2 window by window and join them."""
    config, windows, labelled = windowed.config, windowed.windows, windowed.labelled
    keys, dropped, initial = [], Counter[str](), given_poses(windowed.sequence, config)
    key, intrinsics, intrinsics_covariance, solves = _calibration(windowed, key, hooks)
    for window in windows:
        key = stage_key(key, [window.start, window.stop])

        def compute(window: Window = window) -> StageRecord:
            scene, done, lost = solve_scene(
                tracks_in(labelled, window.frames), window, intrinsics, intrinsics, initial, config, hooks,
                windowed.run, timestamps=windowed.sequence.timestamps,
            )  # fmt: skip
            stop_if_cancelled(done, _STOPPED)
            return StageRecord(scene.arrays(), {"solves": [solve_dict(s) for s in done], "dropped": lost})

        found = windowed.record("scene", window, key, compute)
        keys.append(key)
        solves += found.summary["solves"]
        dropped.update(found.summary["dropped"])

    def scene_of(index: int) -> WindowScene:
        record = windowed.store.load(f"scene_{windows[index].start:06d}", keys[index])
        if record is None:
            raise InputError(f"{windowed.store.folder}: the record of frames {windows[index]} is gone; start again")
        return WindowScene.of_arrays(windows[index], record.arrays)

    joined = _join(windowed, scene_of, intrinsics_covariance)
    cameras = joined.cameras
    parts = []
    for index in range(len(windows)):
        windowed.check_cancelled()
        parts.append(finish(scene_of(index), cameras, config.bundle_adjustment, windowed.run))
    solves += [solve_dict(s) for part in parts for s in part.solves]
    dropped["landmark far from its neighbors"] = sum(part.dropped for part in parts)
    arrays = _joined_arrays(windows, joined, parts)
    summary = bundle_summary(windowed.sequence, arrays, int(sum(part.count.sum() for part in parts)), dropped, solves)
    summary["facts"].append(f"{len(windows)} windows of {len(windows[0])} frames, joined {config.windows.rounds} times")
    return StageRecord(arrays, summary)


def motion_step(windowed: WindowedRun, scene: Arrays, key: str, hooks: Hooks) -> StageRecord:
    """Solve stage 3 window by window and blend the trajectories where windows overlap."""
    records = []
    for window in windowed.windows:
        key = stage_key(key, [window.start, window.stop])

        def compute(window: Window = window) -> StageRecord:
            here = tracks_in(windowed.labelled, window.frames)
            run = NumberedRunner(windowed.run, window.frames, here.track, own_world=False)
            record = nonrigid_step(here.labelled, _scene_part(scene, window, here.track), windowed.config, hooks, run)
            arrays = {**record.arrays, "track": here.track[record.arrays["track"]]}
            return StageRecord(arrays, record.summary)

        records.append(windowed.record("motion", window, key, compute))
    weights = [blend_weight(windowed.windows, i) for i in range(len(windowed.windows))]
    arrays = join_motion(windowed.windows, weights, [record.arrays for record in records])
    summary = _joined_summary(arrays, [record.summary for record in records])
    if windowed.config.rigid_objects.enabled:
        summary["facts"].append(NOT_IN_WINDOWS)
    return StageRecord(arrays, summary)


def _calibration(
    windowed: WindowedRun, key: str, hooks: Hooks
) -> tuple[str, FloatArray, FloatArray, list[dict[str, Any]]]:
    """Return the key so far, the intrinsics of all windows, their covariance, and the solves."""
    config, given = windowed.config, windowed.sequence.intrinsics
    if config.input.intrinsics != "free":
        return key, given, np.zeros((4, 4)), []
    frames = len(windowed.windows[0])

    def compute() -> StageRecord:
        found, covariance, solves = calibrate(windowed.labelled, given, frames, config, hooks, windowed.run)
        stop_if_cancelled(solves, _STOPPED)
        return StageRecord({"intrinsics": found, "covariance": covariance}, {"solves": [solve_dict(s) for s in solves]})

    key = stage_key(key, "calibration")
    found = windowed.record("calibration", windowed.windows[0], key, compute)
    return key, found.arrays["intrinsics"], found.arrays["covariance"], found.summary["solves"]


def _join(windowed: WindowedRun, scene_of: Callable[[int], WindowScene], intrinsics_covariance: FloatArray) -> Joined:
    """Join the windows' cameras in rounds; landmarks follow before each linearization but the first."""
    config, windows = windowed.config, windowed.windows
    spans = TrackSpans.of(windowed.labelled)
    cameras = chain(windows, [scene_of(i).cameras for i in range(len(windows))])
    rounds, adding = config.windows.rounds, isinstance(windowed.run, AddingRunner)
    for number in range(rounds):
        parts = []
        for index in range(len(windows)):
            windowed.check_cancelled()
            scene = scene_of(index)
            if number:
                scene = place(scene, cameras, config.bundle_adjustment, windowed.run)
            mine = owned(scene, spans, windows, index)
            parts.append(information(mine, windows, index, config, log_scale_priors=not adding))
        added = added_terms(windowed.run, cameras, config) if isinstance(windowed.run, AddingRunner) else None
        joined = join(parts, cameras, intrinsics_covariance, covariance=number == rounds - 1, added=added)
        cameras = joined.cameras
        if added is not None:
            added.keep(windowed.run)
        if added is None or not added.is_metric:
            cameras = Cameras.of(hold_metric_scale(cameras.state(np.zeros((0, 3)))))
    return replace(joined, cameras=cameras)


def _joined_arrays(windows: list[Window], joined: Joined, parts: list[WindowLandmarks]) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of a stage 2 record; a landmark of several windows counts once, as the weighted mean."""
    cameras = joined.cameras
    all_tracks = np.concatenate([part.track for part in parts])
    count = np.concatenate([part.count for part in parts]).astype(np.float64)
    track, row = np.unique(all_tracks, return_inverse=True)
    total = np.bincount(row, count, len(track))
    stacked = np.concatenate([part.point for part in parts])
    point = np.stack([np.bincount(row, count * stacked[:, a], len(track)) for a in range(3)], axis=1) / total[:, None]
    error = np.bincount(row, count * np.concatenate([part.error for part in parts]), len(track)) / total
    log_scale = np.zeros(len(cameras.log_scale))
    for index, (window, part) in enumerate(zip(windows, parts, strict=True)):
        log_scale[window.start : window.stop] += blend_weight(windows, index) * part.log_scale
    share = np.array([part.count.sum() for part in parts], dtype=np.float64)
    noise = np.average(
        [[part.noise.reprojection_sigma_px, part.noise.depth_sigma] for part in parts], axis=0, weights=share
    )
    pose_covariance, intrinsics_covariance = joined.pose_covariance, joined.intrinsics_covariance
    if not np.isfinite(pose_covariance).all():
        pose_covariance, intrinsics_covariance = unknown_covariances(len(cameras.world_T_cam))
    return {
        "world_T_cam": cameras.world_T_cam, "intrinsics": cameras.intrinsics, "log_scale": log_scale,
        "landmarks": point, "landmark_track": track, "landmark_error": error.astype(np.float32),
        "pose_covariance": pose_covariance, "intrinsics_covariance": intrinsics_covariance, "noise": noise,
    }  # fmt: skip


def _scene_part(scene: Arrays, window: Window, track: IntArray) -> Arrays:
    """Return the part of a stage 2 record that stage 3 reads, for a window with these tracks."""
    frames = slice(window.start, window.stop)
    at = np.minimum(np.searchsorted(track, scene["landmark_track"]), max(len(track) - 1, 0))
    here = track[at] == scene["landmark_track"] if len(track) else np.zeros(len(at), dtype=bool)
    return {
        **scene,
        "world_T_cam": scene["world_T_cam"][frames],
        "log_scale": scene["log_scale"][frames],
        "landmarks": scene["landmarks"][here],
        "landmark_track": at[here],
    }


def _joined_summary(arrays: Arrays, summaries: list[dict[str, Any]]) -> dict[str, Any]:
    dropped = Counter[str]()
    for summary in summaries:
        dropped.update(summary["dropped"])
    out: dict[str, Any] = {
        "solves": [solve for summary in summaries for solve in summary["solves"]],
        "dropped": dict(dropped),
        "facts": [
            f"{counted(len(arrays['track']), 'trajectory', 'trajectories')} of "
            f"{counted(len(np.unique(arrays['instance'])), 'instance')}"
        ],
    }
    warnings = dict.fromkeys(text for summary in summaries for text in summary.get("warnings", []))
    if warnings:
        out["warnings"] = list(warnings)
    return out
