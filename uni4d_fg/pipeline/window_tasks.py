"""What is done for one window, on its own: plain data in, a record on disk or plain data out, in whatever process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar, overload

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.errors import InputError
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.pipeline.steps import nonrigid_step, stop_if_cancelled
from uni4d_fg.pipeline.store import StageRecord, StageStore
from uni4d_fg.pipeline.summary import solve_dict
from uni4d_fg.slam.stages.scene import Cameras
from uni4d_fg.slam.windows.information import WindowInformation
from uni4d_fg.slam.windows.numbered import NumberedRunner
from uni4d_fg.slam.windows.plan import TrackSpans, Window, WindowTracks
from uni4d_fg.slam.windows.scene import (
    WindowLandmarks,
    WindowScene,
    finish,
    information,
    owned,
    place,
    solve_scene,
)

ItemT = TypeVar("ItemT")

STOPPED = "stopped; finished windows are kept, --resume continues from them"


@dataclass(frozen=True)
class Place:
    """Where the record of a window is."""

    store: StageStore
    file: str
    key: str
    window: Window

    def save(self, record: StageRecord) -> None:
        """Write it. Raises OutputError."""
        self.store.save(self.file, self.key, record)

    def load(self, arrays: Iterable[str] | None = None) -> StageRecord:
        """Read it, or some of its arrays. Raises InputError if it is not there any more."""
        record = self.store.load(self.file, self.key, arrays)
        if record is None:
            raise InputError(f"{self.store.folder}: the record of frames {self.window} is gone; start again")
        return record

    def scene(self) -> WindowScene:
        """Return the static scene that was recorded. Raises InputError."""
        return WindowScene.of_arrays(self.window, self.load().arrays)


@dataclass(frozen=True)
class SceneItem:
    """Stages 1 and 2 of a window."""

    place: Place
    tracks: WindowTracks
    intrinsics: FloatArray
    initial_world_T_cam: FloatArray | None
    timestamps: FloatArray
    config: Config
    linearized: InformationItem
    """How it is linearized where it was solved."""


@dataclass(frozen=True)
class InformationItem:
    """What a window tells the join."""

    place: Place
    windows: list[Window]
    index: int
    spans: TrackSpans
    cameras: Cameras | None
    """Joined; None to linearize it where it was solved."""
    log_scale_priors: bool
    uncertain: bool
    """Whether covariances will be made of it."""
    config: Config


@dataclass(frozen=True)
class LandmarksItem:
    """A window's landmarks under the joined cameras."""

    place: Place
    cameras: Cameras
    config: Config


@dataclass(frozen=True)
class MotionItem:
    """Stage 3 of a window."""

    place: Place
    tracks: WindowTracks
    scene: Mapping[str, npt.NDArray[Any]]
    """The part of a stage 2 record that stage 3 reads."""
    config: Config


def solve_window_scene(item: SceneItem, run: StageRunner, hooks: Hooks) -> WindowInformation:
    """Solve stages 1 and 2 of a window, write its record, and linearize it there.

    Raises:
        DegenerateProblemError: If the cues do not determine the window's cameras.
        SolverError: If a system is singular or a cue is not finite.
        Cancelled: If ``hooks`` said so.
        OutputError: If the record cannot be written.
    """
    scene, done, lost = solve_scene(
        item.tracks, item.place.window, item.intrinsics, item.intrinsics, item.initial_world_T_cam, item.config, hooks,
        run, timestamps=item.timestamps,
    )  # fmt: skip
    stop_if_cancelled(done, STOPPED)
    item.place.save(StageRecord(scene.arrays(), {"solves": [solve_dict(s) for s in done], "dropped": lost}))
    # From its record, as when windows are taken over from it.
    return window_information(item.linearized, run, hooks)


def window_information(item: InformationItem, run: StageRunner, hooks: Hooks) -> WindowInformation:
    """Linearize a window at the joined cameras, or where it was solved.

    Raises:
        InputError: If its record is gone.
        SolverError: If a factor is not finite.
    """
    scene = item.place.scene()
    if item.cameras is not None:
        scene = place(scene, item.cameras, item.config.bundle_adjustment, run)
    mine = owned(scene, item.spans, item.windows, item.index)
    return information(
        mine, item.windows, item.index, item.config, log_scale_priors=item.log_scale_priors, uncertain=item.uncertain
    )


def window_landmarks(item: LandmarksItem, run: StageRunner, hooks: Hooks) -> WindowLandmarks:
    """Return a window's landmarks under the joined cameras. Raises InputError and SolverError."""
    return finish(item.place.scene(), item.cameras, item.config.bundle_adjustment, run)


def solve_window_motion(item: MotionItem, run: StageRunner, hooks: Hooks) -> None:
    """Solve stage 3 of a window and write its record. Raises as :func:`solve_window_scene`."""
    here = item.tracks
    numbered = NumberedRunner(run, item.place.window.frames, here.track, own_world=False)
    record = nonrigid_step(here.labelled, item.scene, item.config, hooks, numbered)
    item.place.save(replace(record, arrays={**record.arrays, "track": here.track[record.arrays["track"]]}))


def scene_part(
    scene: Mapping[str, npt.NDArray[Any]], window: Window, track: IntArray
) -> Mapping[str, npt.NDArray[Any]]:
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


class MadeItems(Sequence[ItemT], Generic[ItemT]):
    """Items that are made when they are asked for: the tracks of all windows at once would be all tracks twice."""

    def __init__(self, numbers: Sequence[int], make: Callable[[int], ItemT]) -> None:
        self.numbers, self.make = numbers, make

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, index: int) -> ItemT: ...
    @overload
    def __getitem__(self, index: slice) -> MadeItems[ItemT]: ...
    def __getitem__(self, index: int | slice) -> ItemT | MadeItems[ItemT]:
        if isinstance(index, slice):
            return MadeItems(self.numbers[index], self.make)
        return self.make(self.numbers[index])
