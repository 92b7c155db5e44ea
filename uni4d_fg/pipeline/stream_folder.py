"""A stream's folder: what left the window, in numbered parts, and a checkpoint to go on from.

A part and then the checkpoint that counts it are written every few frames, each whole or not at all. A process
killed at any moment leaves the last checkpoint and the parts it counts; what came after is computed again. The
trajectory is appended line by line as frames leave the window, for whoever watches, and is cut back on resuming.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz, remove_file, save_npz, write_failure
from uni4d_fg.frontend.trajectory_files import write_tum
from uni4d_fg.geometry.se3 import orthonormalize
from uni4d_fg.geometry.trajectory import Trajectory
from uni4d_fg.pipeline.stream_checkpoint import (
    restore,
    result_arrays,
    results_of,
    seconds_arrays,
    state_arrays,
    take_seconds,
)
from uni4d_fg.pipeline.stream_key import StreamKey
from uni4d_fg.reading import is_present
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.incremental.model import FinishedFrame, Landmarks
from uni4d_fg.slam.incremental.reconstructor import IncrementalReconstructor
from uni4d_fg.slam.incremental.results import ResultsInMemory


class StreamFolder:
    """Results on disk; a :class:`uni4d_fg.slam.incremental.results.Results`.

    Args:
        root: Folder of the run.
    """

    def __init__(self, root: Path):
        self.root = root
        self.num_parts = 0
        self._frames: list[FinishedFrame] = []
        self._landmarks: list[Landmarks] = []

    @property
    def checkpoint(self) -> Path:
        """The state to go on from."""
        return self.root / "stages" / "stream.npz"

    def part(self, number: int) -> Path:
        """Return the file of one part of the results."""
        return self.root / "stages" / "stream" / f"{number:06d}.npz"

    def add(self, frames: tuple[FinishedFrame, ...], landmarks: tuple[Landmarks, ...]) -> None:
        """Keep what left the window for the next part, and append its poses to the trajectory.

        Raises:
            OutputError: If the trajectory cannot be written.
        """
        self._frames += frames
        self._landmarks += landmarks
        if frames:
            self._append(frames)

    def save(self, solver: IncrementalReconstructor, key: StreamKey, seconds: Mapping[str, float]) -> None:
        """Write a part and the checkpoint.

        Args:
            solver: Its state.
            key: What the checkpoint belongs to.
            seconds: Of the stream so far, by part.

        Raises:
            OutputError: If one of them cannot be written.
        """
        self._write_part()
        save_npz(
            self.checkpoint, key=np.array(key.selection), consumed=np.array(key.consumed),
            num_parts=np.array(self.num_parts), **seconds_arrays(seconds), **state_arrays(solver),
        )  # fmt: skip

    def resume(
        self, solver: IncrementalReconstructor, key: StreamKey, should_stop: Callable[[], bool] | None = None
    ) -> dict[str, float] | None:
        """Bring a new solver to the last checkpoint; return the seconds up to there, by part, or None if there is none.

        Raises:
            InputError: If the checkpoint is damaged, or of another configuration, selection or sequence.
            OutputError: If the trajectory cannot be written.
            Cancelled: If ``should_stop`` turned true.
        """
        if not is_present(self.checkpoint):
            return None
        arrays = load_npz(self.checkpoint, {"key": None, "consumed": None, "num_parts": 0, "num_frames": 0})
        try:
            selection, consumed = str(arrays.pop("key")), str(arrays.pop("consumed"))
            key.check(selection, consumed, int(arrays["num_frames"]), should_stop)
        except InputError as error:
            raise InputError(f"{self.checkpoint}: {error}") from error
        self.num_parts = int(arrays.pop("num_parts"))
        seconds = take_seconds(arrays)
        restore(solver, arrays)
        self._rewrite_trajectory()
        return seconds

    def frames(self) -> list[FinishedFrame]:
        """Read all finished frames in order."""
        return self.read().frames()

    def landmarks(self) -> list[Landmarks]:
        """Read all finished landmarks."""
        return self.read().landmarks()

    def read(self) -> ResultsInMemory:
        """Read all finished frames, in order, and landmarks: every file once.

        Raises:
            InputError: If a part is missing or damaged.
        """
        whole = ResultsInMemory()
        for number in range(self.num_parts):
            frames, landmarks = results_of(load_npz(self.part(number), {"frames_frame": None}))
            whole.add(tuple(frames), (landmarks,))
        whole.add(tuple(self._frames), tuple(self._landmarks))
        return whole

    def _write_part(self) -> None:
        if self._frames or self._landmarks:
            save_npz(self.part(self.num_parts), **result_arrays(self._frames, self._landmarks))
            self.num_parts += 1
            self._frames, self._landmarks = [], []

    def _append(self, frames: tuple[FinishedFrame, ...]) -> None:
        from scipy.spatial.transform import Rotation

        path = RunFolder(self.root).trajectory
        quaternions = Rotation.from_matrix(np.stack([f.world_T_cam[:3, :3] for f in frames])).as_quat()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "a", encoding="utf-8") as stream:
                for frame, quaternion in zip(frames, quaternions, strict=True):
                    values = (frame.timestamp, *frame.world_T_cam[:3, 3].tolist(), *quaternion.tolist())
                    stream.write(" ".join(f"{value:.9f}" for value in values) + "\n")
        except OSError as error:
            raise write_failure(path, error) from error

    def _rewrite_trajectory(self) -> None:
        path, frames = RunFolder(self.root).trajectory, self.frames()
        if frames:
            poses = orthonormalize(np.stack([f.world_T_cam for f in frames]))
            write_tum(path, Trajectory(np.array([f.timestamp for f in frames]), poses))
        else:
            remove_file(path)
