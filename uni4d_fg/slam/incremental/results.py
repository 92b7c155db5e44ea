"""What has left the window, collected into the result type of the batch pipeline."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from uni4d_fg.arrays import FloatArray, sum_rows
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.slam.incremental.model import FinishedFrame, Landmarks
from uni4d_fg.slam.reconstruction import Reconstruction


class Finished(Protocol):
    """What has left the window."""

    def frames(self) -> Iterable[FinishedFrame]:
        """Return all finished frames in order."""
        ...

    def landmarks(self) -> Iterable[Landmarks]:
        """Return all finished landmarks."""
        ...


class Results(Finished, Protocol):
    """Takes over what leaves the window; may keep it in memory or write it."""

    def add(self, frames: tuple[FinishedFrame, ...], landmarks: tuple[Landmarks, ...]) -> None:
        """Take over finished frames, in order, and landmarks."""
        ...


@dataclass
class ResultsInMemory:
    """Keeps everything: grows with the video."""

    finished: list[FinishedFrame] = field(default_factory=list)
    finished_landmarks: list[Landmarks] = field(default_factory=list)

    def add(self, frames: tuple[FinishedFrame, ...], landmarks: tuple[Landmarks, ...]) -> None:
        """Keep them."""
        self.finished += frames
        self.finished_landmarks += landmarks

    def frames(self) -> list[FinishedFrame]:
        """Return all finished frames in order."""
        return self.finished

    def landmarks(self) -> list[Landmarks]:
        """Return all finished landmarks."""
        return self.finished_landmarks


def assemble_results(
    results: Finished, intrinsics: FloatArray, intrinsics_covariance: FloatArray, image_size: tuple[int, int],
    lens: Lens = PINHOLE,
) -> Reconstruction:  # fmt: skip
    """Collect a :class:`Reconstruction`; a track whose landmark was started anew counts once, as the weighted mean.

    Trajectories take memory for every frame of the video: 25 bytes per moving track and frame.

    Raises:
        DegenerateProblemError: If there is no frame.
    """
    frames = list(results.frames())
    if not frames:
        raise DegenerateProblemError("no frame was added: there is nothing to reconstruct")
    track, point, error, color = _landmarks(list(results.landmarks()))
    moving = [frame.dynamic for frame in frames]
    tracks = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(m.track for m in moving)]))
    points = np.full((len(tracks), len(frames), 3), np.nan)
    observed = np.zeros((len(tracks), len(frames)), dtype=bool)
    instance = np.zeros(len(tracks), dtype=np.int32)
    colors = np.zeros((len(tracks), 3), dtype=np.uint8)
    for t, here in enumerate(moving):
        row = np.searchsorted(tracks, here.track)
        points[row, t], observed[row, t] = here.point, here.observed
        instance[row], colors[row] = here.instance, here.color
    return Reconstruction(
        lens=lens,
        world_T_cam=np.stack([frame.world_T_cam for frame in frames]),
        intrinsics=intrinsics,
        timestamps=np.array([frame.timestamp for frame in frames]),
        image_size=image_size,
        depth_log_scale=np.array([frame.log_scale for frame in frames]),
        landmarks=point,
        landmark_track=track.astype(np.int32),
        landmark_color=color,
        landmark_error=error.astype(np.float32),
        dynamic_points=points,
        dynamic_observed=observed,
        dynamic_track=tracks.astype(np.int32),
        dynamic_instance=instance,
        dynamic_color=colors,
        pose_covariance=np.stack([frame.covariance for frame in frames]),
        intrinsics_covariance=intrinsics_covariance,
    )


def _landmarks(parts: list[Landmarks]) -> tuple[np.ndarray, FloatArray, FloatArray, np.ndarray]:
    empty = np.zeros(0, dtype=np.int64)
    all_tracks = np.concatenate([empty, *(part.track for part in parts)])
    track, first, row = np.unique(all_tracks, return_index=True, return_inverse=True)
    count = np.concatenate([empty, *(part.count for part in parts)]).astype(np.float64)
    total = np.bincount(row, count, len(track))
    stacked = np.concatenate([np.zeros((0, 3)), *(part.point for part in parts)])
    point = sum_rows(count[:, None] * stacked, row, len(track)) / total[:, None]
    error = np.bincount(row, count * np.concatenate([np.zeros(0), *(p.error for p in parts)]), len(track)) / total
    color = np.concatenate([np.zeros((0, 3), dtype=np.uint8), *(part.color for part in parts)])[first]
    return track, point, error, color
