"""A long stream: what the solver holds does not grow, and the path does not drift."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stream_samples import stream_config

from uni4d_fg.frontend.synthetic.hall import HallConfig, given_intrinsics, hall_frames, hall_poses
from uni4d_fg.pipeline.stream_checkpoint import state_arrays
from uni4d_fg.slam.incremental import FinishedFrame, FrameTracks, IncrementalReconstructor, Landmarks

HALL = HallConfig(num_frames=300, height=120, width=160, focal=130.0, new_tracks=60, track_life=30)


class Counted:
    """Results that keep the poses only."""

    def __init__(self) -> None:
        self.poses: list[np.ndarray] = []

    def add(self, frames: tuple[FinishedFrame, ...], landmarks: tuple[Landmarks, ...]) -> None:
        self.poses += [frame.world_T_cam for frame in frames]

    def frames(self) -> tuple[FinishedFrame, ...]:
        return ()

    def landmarks(self) -> tuple[Landmarks, ...]:
        return ()


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


@pytest.mark.slow
def test_memory_is_flat_and_the_path_does_not_drift() -> None:
    results = Counted()
    solver = IncrementalReconstructor(
        given_intrinsics(HALL), (HALL.height, HALL.width), stream_config("incremental.window=8"), results
    )
    held, resident, live = [], [], []
    for frame in hall_frames(HALL):
        solver.add_frame(frame.image, frame.depth, frame.mask, FrameTracks(frame.track, frame.uv))
        held.append(sum(array.nbytes for array in state_arrays(solver).values()))
        resident.append(resident_mb())
        live.append(len(frame.track))
    solver.flush()
    # What is held follows the number of tracks that happen to be in view, and nothing else.
    per_track = np.array(held) / np.array(live)
    assert np.mean(held[-100:]) < 1.1 * np.mean(held[100:200]) * max(np.mean(live[-100:]) / np.mean(live[100:200]), 1.0)
    assert np.mean(per_track[-100:]) < 1.1 * np.mean(per_track[100:200])
    assert max(resident[-100:]) < 1.1 * max(resident[:200])
    truth = np.linalg.inv(hall_poses(HALL)[0]) @ hall_poses(HALL)
    assert len(results.poses) == HALL.num_frames
    error = np.linalg.norm(np.stack(results.poses)[:, :3, 3] - truth[:, :3, 3], axis=1)
    path = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    # 150 tracks on 160 x 120 px; benchmarks/streaming.py has the figures at full size.
    assert error.max() < 0.04 * path
