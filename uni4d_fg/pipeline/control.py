"""Points of every frame whose depth is known besides the cue: landmarks, and what moves."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import BoolArray, FloatArray, Int32Array, IntArray
from uni4d_fg.config.stages import FusionConfig
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry.camera import world_to_camera
from uni4d_fg.pipeline.landmark_sigma import common_sigma, landmark_shares, variance_of_rays
from uni4d_fg.pipeline.steps import Arrays
from uni4d_fg.results.fusion.densify import ControlPoints
from uni4d_fg.slam.stages.contradicting_depth import contradicting_frames


@dataclass(frozen=True)
class StaticControl:
    """What landmarks alone say of the frames."""

    frames: list[ControlPoints]
    """The landmarks that each frame sees with a cue."""
    broken: list[int]
    """Frames whose cue contradicts them."""
    sigma: float
    """Standard deviation of log depth that is made of them alone."""


def static_control(
    labelled: LabelledTracks, scene: Arrays, intrinsics: FloatArray, config: FusionConfig
) -> StaticControl:
    """Compare the landmarks with the depth cue of all frames.

    Args:
        labelled: Observations, with the cue at each.
        scene: Record of stage 2.
        intrinsics: (T, 4) px.
        config: When a cue counts as broken.
    """
    variance = variance_of_rays(labelled, scene, intrinsics)
    shares = landmark_shares(labelled, scene, variance)
    track: IntArray = scene["landmark_track"]
    frames = []
    for frame, pose in enumerate(scene["world_T_cam"]):
        seen: BoolArray = (labelled.weight[track, frame] > 0) & np.isfinite(labelled.depth[track, frame])
        points: FloatArray = scene["landmarks"][seen]
        instance: Int32Array = np.zeros(len(points), dtype=np.int32)
        frames.append(_points(labelled, track[seen], points, instance, shares[seen], frame, pose))
    broken = contradicting_frames([(points.cue, points.log_scale) for points in frames], config)
    return StaticControl(frames, broken, common_sigma(variance))


def with_moving(
    static: ControlPoints, labelled: LabelledTracks, scene: Arrays, motion: Arrays, frame: int
) -> ControlPoints:
    """Return the landmarks of a frame and the moving points, of the record of stage 3, that it sees with a cue."""
    track: IntArray = motion["track"]
    here: BoolArray = motion["observed"][:, frame] & np.isfinite(labelled.depth[track, frame])
    points: FloatArray = motion["points"][here, frame]
    instance: Int32Array = motion["instance"][here].astype(np.int32)
    share = np.ones(len(points))
    moving = _points(labelled, track[here], points, instance, share, frame, scene["world_T_cam"][frame])
    assert static.share is not None
    return ControlPoints(
        np.concatenate([static.uv, moving.uv]),
        np.concatenate([static.cue, moving.cue]),
        np.concatenate([static.log_scale, moving.log_scale]),
        np.concatenate([static.instance, moving.instance]),
        np.concatenate([static.points, moving.points]),
        np.concatenate([static.share, share]),
    )


def _points(
    labelled: LabelledTracks, track: IntArray, points: FloatArray, instance: Int32Array, share: FloatArray, frame: int,
    world_T_cam: FloatArray,
) -> ControlPoints:  # fmt: skip
    z = world_to_camera(np.broadcast_to(world_T_cam, (len(points), 4, 4)), points)[:, 2]
    cue = labelled.depth[track, frame].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        log_scale = np.where(z > 0, np.log(np.maximum(z, 1e-9)) - np.log(cue), np.nan)
    return ControlPoints(labelled.tracks.uv[track, frame].astype(np.float64), cue, log_scale, instance, points, share)


class BegunControl:
    """The static control of a run, which may be begun in a thread while other processes solve stage 3."""

    def __init__(self, make: Callable[[Arrays], StaticControl]) -> None:
        """Take what makes it of the record of stage 2."""
        self._make = make
        self._begun: Future[StaticControl] | None = None

    def begin(self, scene: Arrays) -> None:
        """Begin with it."""
        beside = ThreadPoolExecutor(1)
        self._begun = beside.submit(self._make, scene)
        beside.shutdown(wait=False)

    def of(self, scene: Arrays) -> StaticControl:
        """Return it, made now unless it was begun with this record."""
        return self._make(scene) if self._begun is None else self._begun.result()
