"""A stream's folder: what left the window, in numbered parts, and a checkpoint to go on from.

A part and then the checkpoint that counts it are written every few frames, each whole or not at all. A process
killed at any moment leaves the last checkpoint and the parts it counts; what came after is computed again. The
trajectory is appended line by line as frames leave the window, for whoever watches, and is cut back on resuming.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from uni4d_fg.config.models import Config
from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz, save_npz, write_failure
from uni4d_fg.frontend.trajectory_files import write_tum
from uni4d_fg.geometry.se3 import orthonormalize
from uni4d_fg.geometry.trajectory import Trajectory
from uni4d_fg.optim.added_factors import fingerprints
from uni4d_fg.pipeline.stream_checkpoint import restore, result_arrays, results_of, state_arrays
from uni4d_fg.results.run_folder import RunFolder
from uni4d_fg.slam.incremental.model import FinishedFrame, Landmarks
from uni4d_fg.slam.incremental.reconstructor import IncrementalReconstructor


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

    def save(self, solver: IncrementalReconstructor, config: Config) -> None:
        """Write a part and the checkpoint.

        Raises:
            OutputError: If one of them cannot be written.
        """
        self._write_part()
        key = np.array(_key(solver, config))
        save_npz(self.checkpoint, key=key, num_parts=np.array(self.num_parts), **state_arrays(solver))

    def resume(self, solver: IncrementalReconstructor, config: Config) -> bool:
        """Bring a new solver to the last checkpoint; False if there is none.

        Raises:
            InputError: If the checkpoint is damaged, or of another configuration or sequence.
            OutputError: If the trajectory cannot be written.
        """
        if not self.checkpoint.exists():
            return False
        arrays = load_npz(self.checkpoint, {"key": None, "num_parts": None})
        if str(arrays.pop("key")) != _key(solver, config):
            raise InputError(
                f"{self.checkpoint}: was written with another configuration, sequence or measurements; use those "
                "again, or start anew with --overwrite"
            )
        self.num_parts = int(arrays.pop("num_parts"))
        restore(solver, arrays)
        self._rewrite_trajectory()
        return True

    def close(self) -> None:
        """Write what is left as a last part."""
        self._write_part()

    def remove_leftovers(self) -> None:
        """Remove temporary files of parts that a killed process could not remove.

        Raises:
            OutputError: If one cannot be removed.
        """
        for path in self.part(0).parent.glob(".tmp-*.npz"):
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise write_failure(path, error) from error

    def frames(self) -> Iterator[FinishedFrame]:
        """Read all finished frames in order."""
        for number in range(self.num_parts):
            yield from results_of(self._load(number))[0]
        yield from self._frames

    def landmarks(self) -> Iterator[Landmarks]:
        """Read all finished landmarks."""
        for number in range(self.num_parts):
            yield results_of(self._load(number))[1]
        yield from self._landmarks

    def _load(self, number: int) -> dict[str, np.ndarray]:
        return load_npz(self.part(number), {"frames_frame": None})

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
        path, frames = RunFolder(self.root).trajectory, list(self.frames())
        if frames:
            poses = orthonormalize(np.stack([f.world_T_cam for f in frames]))
            write_tum(path, Trajectory(np.array([f.timestamp for f in frames]), poses))
        else:
            path.unlink(missing_ok=True)


def _key(solver: IncrementalReconstructor, config: Config) -> str:
    digest = hashlib.blake2b(config.model_dump_json(exclude={"output", "fusion"}).encode(), digest_size=16)
    digest.update(f"{solver.image_size} {solver.window.prior_intrinsics.tolist()}".encode())
    digest.update("".join(fingerprints(solver.window.sources)).encode())
    return digest.hexdigest()
