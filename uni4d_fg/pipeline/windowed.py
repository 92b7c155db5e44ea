"""Stages 1 to 3 in windows: each window's record is kept, and the joined ones look like those of one graph."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, sum_rows
from uni4d_fg.config.models import Config
from uni4d_fg.counted import counted
from uni4d_fg.errors import Cancelled
from uni4d_fg.factors.variable_types import LANDMARK, LOG_SCALE, POSE
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.optim.added_factors import AddingRunner
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.fingerprint import stage_key
from uni4d_fg.pipeline.rigid import NOT_IN_WINDOWS
from uni4d_fg.pipeline.steps import Arrays, bundle_summary, given_poses, stop_if_cancelled
from uni4d_fg.pipeline.store import StageRecord, StageStore
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.pipeline.window_tasks import (
    STOPPED,
    InformationItem,
    LandmarksItem,
    MadeItems,
    MotionItem,
    Place,
    SceneItem,
    scene_part,
    solve_window_motion,
    solve_window_scene,
    window_information,
    window_landmarks,
)
from uni4d_fg.pipeline.window_workers import InOrder, SolveEach, WindowWorkers
from uni4d_fg.progress import Reporter
from uni4d_fg.slam.stages.bundle_adjustment import hold_metric_scale
from uni4d_fg.slam.stages.scene import Cameras, unknown_covariances
from uni4d_fg.slam.windows.added_terms import added_terms
from uni4d_fg.slam.windows.information import WindowInformation
from uni4d_fg.slam.windows.join import Covariances, chain, join
from uni4d_fg.slam.windows.motion import join_motion
from uni4d_fg.slam.windows.plan import TrackSpans, Window, blend_weight, tracks_in
from uni4d_fg.slam.windows.scene import WindowLandmarks, calibrate

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")
KeptT = TypeVar("KeptT")


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
    workers: WindowWorkers | None = None
    """Where windows are solved at once; None: one after the other in this process."""

    def places(self, name: str, key: str) -> list[Place]:
        """Return where the windows' records of this name are: a window builds on the plan up to it."""
        found = []
        for window in self.windows:
            key = stage_key(key, [window.start, window.stop])
            found.append(Place(self.store, f"{name}_{window.start:06d}", key, window))
        return found

    def solve_each(self, hooks: Hooks) -> SolveEach:
        """Return what solves independent windows."""
        return self.workers or InOrder(self.run, hooks)

    def records(
        self, places: list[Place], make: Callable[[int, Place], ItemT],
        solve: Callable[[ItemT, StageRunner, Hooks], ResultT], hooks: Hooks, keep: Callable[[StageRecord], KeptT],
        arrays: Iterable[str] | None = None,
    ) -> tuple[list[KeptT], dict[int, ResultT]]:  # fmt: skip
        """Make sure that every window has its record: the stored one of the same key when resuming, else a new one.

        The last window is always solved: its factor graph is that of the step, and not part of the record.

        Args:
            places: Of the records.
            make: Returns what a window is solved from.
            solve: Solves it and writes its record.
            hooks: Progress and cancellation.
            keep: Returns what is needed of a record; they are read while other windows are solved.
            arrays: Of a record, those that this takes; None for all of them.

        Returns:
            What is kept of each record, and what the solves of windows that had none returned.

        Raises:
            Cancelled: If the user interrupts; finished windows are kept.
            OutputError: If a record cannot be written.
            InputError: If it is gone again.
        """
        windows = self.windows
        last = len(windows) - 1
        kept, results = dict[int, KeptT](), dict[int, ResultT]()
        for index in range(last if self.resume else 0):
            stored = self.store.load(places[index].file, places[index].key, arrays)
            if stored is not None:
                kept[index] = keep(stored)
        left = [index for index in range(len(windows)) if index not in kept]
        items = MadeItems(left, lambda index: make(index, places[index]))
        done = sum(len(windows[index]) for index in kept)
        for number, result in self.solve_each(hooks)(solve, items):
            index = left[number]
            results[index], kept[index] = result, keep(places[index].load(arrays))
            done += len(windows[index])
            self.reporter.advance(done, f"frames {windows[index]} of {windows[-1].stop}")
        return [kept[index] for index in range(len(windows))], results

    def check_cancelled(self) -> None:
        """Stop if the user asked for it.

        Raises:
            Cancelled: Then.
        """
        if self.should_stop():
            raise Cancelled(STOPPED)


def scene_step(windowed: WindowedRun, key: str, hooks: Hooks) -> StageRecord:
    """Solve stages 1 and 2 window by window and join them."""
    config, windows, labelled = windowed.config, windowed.windows, windowed.labelled
    dropped, initial = Counter[str](), given_poses(windowed.sequence, config)
    key, intrinsics, intrinsics_covariance, solves = _calibration(windowed, key, hooks)

    share = _Shared(windows, TrackSpans.of(labelled), not isinstance(windowed.run, AddingRunner), config)

    def item(index: int, place: Place) -> SceneItem:
        tracks = tracks_in(labelled, windows[index].frames)
        times = windowed.sequence.timestamps
        return SceneItem(place, tracks, intrinsics, initial, times, config, share.item(0, index, place, None))

    places = windowed.places("scene", key)
    told, known = windowed.records(places, item, solve_window_scene, hooks, _told, _TOLD)
    for one in told:
        solves += one.solves
        dropped.update(one.dropped)
    cameras = chain(windows, [one.cameras for one in told])
    cameras, covariances, cue_holds_scale = _join(windowed, share, places, known, cameras, intrinsics_covariance, hooks)
    items = MadeItems(range(len(windows)), lambda i: LandmarksItem(places[i], cameras, config))
    with ThreadPoolExecutor(1) as beside:
        # While workers solve windows this process is idle.
        made = None if windowed.workers is None else beside.submit(covariances)
        parts = _in_order(windowed.solve_each(hooks)(window_landmarks, items))
        found = covariances() if made is None else made.result()
    solves += [solve_dict(s) for part in parts for s in part.solves]
    dropped["landmark far from its neighbors"] = sum(part.dropped for part in parts)
    arrays = _joined_arrays(windows, cameras, found, parts, cue_holds_scale)
    count = int(sum(part.count.sum() for part in parts))
    summary = bundle_summary(windowed.sequence, labelled, arrays, count, dropped, solves)
    summary["facts"].append(f"{len(windows)} windows of {len(windows[0])} frames, joined {config.windows.rounds} times")
    return StageRecord(arrays, summary)


def motion_step(windowed: WindowedRun, scene: Arrays, key: str, hooks: Hooks) -> StageRecord:
    """Solve stage 3 window by window and blend the trajectories where windows overlap."""
    windows = windowed.windows

    def item(index: int, place: Place) -> MotionItem:
        here = tracks_in(windowed.labelled, windows[index].frames)
        return MotionItem(place, here, scene_part(scene, windows[index], here.track), windowed.config)

    records, _ = windowed.records(
        windowed.places("motion", key), item, solve_window_motion, hooks, lambda record: record
    )
    weights = [blend_weight(windows, i) for i in range(len(windows))]
    arrays = join_motion(windows, weights, [record.arrays for record in records])
    summary = _joined_summary(arrays, [record.summary for record in records])
    if windowed.config.rigid_objects.enabled:
        summary["facts"].append(NOT_IN_WINDOWS)
    return StageRecord(arrays, summary)


@dataclass(frozen=True)
class _Told:
    """What is needed of the record of a window's static scene, but for its linearization."""

    solves: list[dict[str, Any]]
    dropped: dict[str, int]
    cameras: Cameras


_TOLD = ("world_T_cam", "intrinsics", "log_scale")


def _told(record: StageRecord) -> _Told:
    cameras = Cameras(**{name: record.arrays[name] for name in _TOLD})
    return _Told(record.summary["solves"], record.summary["dropped"], cameras)


@dataclass(frozen=True)
class _Shared:
    """What all windows are linearized with."""

    windows: list[Window]
    spans: TrackSpans
    log_scale_priors: bool
    config: Config

    def item(self, number: int, index: int, place: Place, cameras: Cameras | None) -> InformationItem:
        """Return what a window is linearized from, in round ``number``: covariances are those of the last one."""
        last = number == self.config.windows.rounds - 1
        return InformationItem(
            place, self.windows, index, self.spans, cameras, self.log_scale_priors, last, self.config
        )  # fmt: skip


def _in_order(found: Iterable[tuple[int, ResultT]]) -> list[ResultT]:
    return [result for _, result in sorted(found, key=lambda pair: pair[0])]


def _calibration(
    windowed: WindowedRun, key: str, hooks: Hooks
) -> tuple[str, FloatArray, FloatArray, list[dict[str, Any]]]:
    """Return the key so far, the intrinsics of all windows, their covariance, and the solves."""
    config, given = windowed.config, windowed.sequence.intrinsics
    if config.input.intrinsics != "free":
        return key, given, np.zeros((4, 4)), []
    key = stage_key(key, "calibration")
    found = windowed.store.load("calibration_000000", key) if windowed.resume else None
    if found is None:
        windowed.check_cancelled()
        intrinsics, covariance, solves = calibrate(
            windowed.labelled, given, len(windowed.windows[0]), config, hooks, windowed.run
        )
        stop_if_cancelled(solves, STOPPED)
        arrays = {"intrinsics": intrinsics, "covariance": covariance}
        found = StageRecord(arrays, {"solves": [solve_dict(s) for s in solves]})
        windowed.store.save("calibration_000000", key, found)
    return key, found.arrays["intrinsics"], found.arrays["covariance"], found.summary["solves"]


def _join(
    windowed: WindowedRun, share: _Shared, places: list[Place], known: dict[int, WindowInformation], cameras: Cameras,
    intrinsics_covariance: FloatArray, hooks: Hooks,
) -> tuple[Cameras, Callable[[], Covariances], bool]:  # fmt: skip
    """Join the windows' cameras in rounds; landmarks follow before each linearization but the first.

    Args:
        windowed: The run.
        share: What windows are linearized with.
        places: Of the windows' scenes.
        known: Of windows that were solved just now, how they are linearized for the first round.
        cameras: Where the first round starts.
        intrinsics_covariance: (4, 4).
        hooks: Progress and cancellation.

    Returns:
        The cameras, what computes their covariances, and whether nothing but the depth cue holds their scale.
    """
    known, cue_holds_scale = dict(known), True
    for number in range(windowed.config.windows.rounds):
        left = [index for index in range(len(places)) if index not in known]
        items = [share.item(number, index, places[index], cameras if number else None) for index in left]
        for at, part in windowed.solve_each(hooks)(window_information, items):
            known[left[at]] = part
        parts = [known.pop(index) for index in range(len(places))]
        added = added_terms(windowed.run, cameras, windowed.config) if isinstance(windowed.run, AddingRunner) else None
        joined = join(parts, cameras, intrinsics_covariance, added)
        cameras = joined.cameras
        if added is not None:
            added.keep(windowed.run)
        cue_holds_scale = added is None or not added.is_metric
        if cue_holds_scale:
            cameras = Cameras.of(hold_metric_scale(cameras.state(np.zeros((0, 3)))))
    return cameras, joined.covariances, cue_holds_scale


def _joined_arrays(
    windows: list[Window], cameras: Cameras, covariances: Covariances, parts: list[WindowLandmarks],
    cue_holds_scale: bool,
) -> dict[str, npt.NDArray[Any]]:  # fmt: skip
    """Return the arrays of a stage 2 record; a landmark of several windows counts once, as the weighted mean."""
    all_tracks = np.concatenate([part.track for part in parts])
    count = np.concatenate([part.count for part in parts]).astype(np.float64)
    track, row = np.unique(all_tracks, return_inverse=True)
    total = np.bincount(row, count, len(track))
    stacked = np.concatenate([part.point for part in parts])
    point = sum_rows(count[:, None] * stacked, row, len(track)) / total[:, None]
    error = np.bincount(row, count * np.concatenate([part.error for part in parts]), len(track)) / total
    log_scale = np.zeros(len(cameras.log_scale))
    for index, (window, part) in enumerate(zip(windows, parts, strict=True)):
        log_scale[window.start : window.stop] += blend_weight(windows, index) * part.log_scale
    state = replace(cameras, log_scale=log_scale).state(point)
    if cue_holds_scale:
        state = hold_metric_scale(state)
    share = np.array([part.count.sum() for part in parts], dtype=np.float64)
    noise = np.average([part.noise.array() for part in parts], axis=0, weights=share)
    pose_covariance, intrinsics_covariance = covariances
    if not np.isfinite(pose_covariance).all():
        pose_covariance, intrinsics_covariance = unknown_covariances(len(cameras.world_T_cam))
    return {
        "world_T_cam": state[POSE], "intrinsics": cameras.intrinsics, "log_scale": state[LOG_SCALE][:, 0],
        "landmarks": state[LANDMARK], "landmark_track": track, "landmark_error": error.astype(np.float32),
        "pose_covariance": pose_covariance, "intrinsics_covariance": intrinsics_covariance, "noise": noise,
    }  # fmt: skip


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
