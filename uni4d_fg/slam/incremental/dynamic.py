"""Moving points: stage 3 on the last few frames, cameras frozen.

The window reaches further back than the frames that are still to be handed over: those before them are solved
again as context, so that smoothness and rigidity do not begin anew at each hand-over. Points are kept in the axes
of their frame's camera until then, because that camera may still move.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, IntArray
from uni4d_fg.config.models import Config
from uni4d_fg.geometry.camera import camera_to_world, world_to_camera
from uni4d_fg.optim.stage import StageRunner
from uni4d_fg.slam.incremental.labels import LabelledFrame, TrackBook
from uni4d_fg.slam.incremental.model import DynamicPoints
from uni4d_fg.slam.incremental.window import no_observations
from uni4d_fg.slam.stages.local_scale import predict_log_scale
from uni4d_fg.slam.stages.nonrigid import solve_nonrigid
from uni4d_fg.slam.stages.observations import Observations
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise


@dataclass
class DynamicWindow:
    """Observations of moving tracks in the last frames, and the latest points."""

    config: Config
    frame: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(F,) frame numbers."""
    pose: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(F, 4, 4) as last known."""
    observations: Observations = field(default_factory=no_observations)
    """``frame`` is the row in the window; depth is scaled already."""
    instance: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(n,) mask id of each observation."""
    depth_sigma: float = 0.03

    def append(self, frame: int, pose: FloatArray, tracks: LabelledFrame, log_scale: FloatArray) -> None:
        """Add the moving observations of a frame with the log-scale (n,) of the cue at each."""
        self.frame = np.append(self.frame, frame)
        self.pose = np.concatenate([self.pose, pose[None]])
        row, old = len(self.frame) - 1, self.observations
        self.observations = Observations(
            np.concatenate([old.track, tracks.track]),
            np.concatenate([old.frame, np.full(len(tracks.track), row)]),
            np.concatenate([old.uv, tracks.uv]),
            np.concatenate([old.depth, tracks.depth * np.exp(log_scale)]),
            np.concatenate([old.weight, tracks.weight]),
        )
        self.instance = np.concatenate([self.instance, tracks.label])
        if len(self.frame) > self.config.incremental.nonrigid_window:
            self._keep(self.observations.frame > 0)
            self.observations = replace(self.observations, frame=self.observations.frame - 1)
            self.frame, self.pose = self.frame[1:], self.pose[1:]

    def remove_tracks(self, track: IntArray) -> None:
        """Forget tracks that turned out to be unreliable."""
        if len(track):
            self._keep(~np.isin(self.observations.track, track))

    def rescale(self, log_scale: float) -> None:
        """Scale what is seen when the world turns out to have other meters."""
        self.observations = replace(self.observations, depth=self.observations.depth * np.exp(log_scale))

    def solve(
        self, intrinsics: FloatArray, noise: StaticNoise, book: TrackBook, run: StageRunner
    ) -> dict[int, DynamicPoints]:
        """Solve the window; return the points of every frame of it, in the axes of its camera."""
        out = dict.fromkeys(self.frame.tolist(), DynamicPoints.none())
        observations = self.observations
        if len(observations) == 0:
            return out
        order = np.lexsort([observations.frame, observations.track])
        observations = observations.select(order)
        tracks, row = observations.rows()
        instance = np.zeros(len(tracks), dtype=np.int64)
        instance[row] = self.instance[order]
        cameras = Cameras(self.pose, intrinsics, np.zeros(len(self.frame)))
        noise = replace(noise, depth_sigma=self.depth_sigma)
        settings = self.config.nonrigid.model_copy(update={"solver": self.config.incremental.nonrigid_solver})
        result = solve_nonrigid(
            replace(observations, track=row),
            instance,
            cameras,
            noise,
            settings,
            run=run,
        )
        colors = book.colors(tracks[result.track])
        for i, frame in enumerate(self.frame.tolist()):
            known = np.isfinite(result.points[:, i]).all(axis=1)
            points = result.points[known, i]
            out[frame] = DynamicPoints(
                tracks[result.track[known]],
                result.instance[known].astype(np.int64),
                world_to_camera(np.broadcast_to(self.pose[i], (len(points), 4, 4)), points),
                result.observed[known, i],
                colors[known],
            )
        return out

    def _keep(self, keep: BoolArray) -> None:
        self.observations, self.instance = self.observations.select(keep), self.instance[keep]


def in_world(points: DynamicPoints, world_T_cam: FloatArray) -> DynamicPoints:
    """Move points from the axes of a camera (4, 4) to the world."""
    moved = camera_to_world(np.broadcast_to(world_T_cam, (len(points.point), 4, 4)), points.point)
    return replace(points, point=moved)


def moving_scales(
    static: LabelledFrame, points: FloatArray, moving: LabelledFrame, world_T_cam: FloatArray, log_scale: float,
    neighbors: int, samples: int,
) -> tuple[FloatArray, float]:  # fmt: skip
    """Return the cue's log-scale (m,) at moving observations of one frame and its sigma (NaN without landmarks).

    Args:
        static: n static observations of the frame.
        points: (n, 3) their landmarks, NaN where there is none.
        moving: m moving observations.
        world_T_cam: (4, 4).
        log_scale: The frame's own.
        neighbors: Static observations per prediction, see :mod:`uni4d_fg.slam.stages.local_scale`.
        samples: Static observations on which the prediction is measured, at most.
    """
    z = world_to_camera(np.broadcast_to(world_T_cam, (len(points), 4, 4)), points)[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = np.log(z) - np.log(static.depth)
    known = np.isfinite(measured)
    if not known.any():
        return np.full(len(moving.track), log_scale), float("nan")
    zero = np.zeros(len(static.track), dtype=np.int64)
    queries = Observations(
        moving.track, np.zeros(len(moving.track), dtype=np.int64), moving.uv, moving.depth, moving.weight
    )
    observations = Observations(static.track, zero, static.uv, static.depth, static.weight)
    local = predict_log_scale(observations, measured, np.array([log_scale]), queries, neighbors, samples)
    return local.log_scale, local.sigma
