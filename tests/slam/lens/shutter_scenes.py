"""Static points seen by a camera whose rows are read one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.track_model import LabelledTracks, Tracks
from uni4d_fg.slam.lens.rolling_shutter import Readout

SIZE = (240, 320)
K = np.array([300.0, 300.0, 159.5, 119.5])
FRAMES, RATE = 24, 30.0
TIMES = np.arange(FRAMES) / RATE


def pose(time: FloatArray) -> tuple[Rotation, FloatArray]:
    """A hand-held camera: rotations (N,) and centers (N, 3) at times (N,) s."""
    w = 2.0 * np.pi * time
    angles = np.stack((6 * np.sin(0.9 * w), 14 * np.sin(0.55 * w + 1), 4 * np.sin(1.3 * w)), axis=1)
    center = np.stack((0.5 * np.sin(0.45 * w), 0.12 * np.sin(0.8 * w + 0.5), 0.3 * time), axis=1)
    return Rotation.from_euler("xyz", angles, degrees=True), center


def project(points: FloatArray, time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) and depths (N,) of points (N, 3) at times (N,)."""
    rotation, center = pose(time)
    x = rotation.inv().apply(points - center)
    return x[:, :2] / x[:, 2:] * K[:2] + K[2:], x[:, 2]


def seen(points: FloatArray, time: float, readout: Readout | None) -> tuple[FloatArray, FloatArray]:
    """Pixels and depths in an image whose middle row is read at a time, s."""
    when = np.full(len(points), time)
    for _ in range(6 if readout is not None else 0):
        assert readout is not None
        when = time + readout.delay(project(points, when)[0], SIZE)
    return project(points, when)


@dataclass(frozen=True)
class ShutterScene:
    """Tracks of static points, and where they are at the times of the middle rows."""

    labelled: LabelledTracks
    still: FloatArray
    """(K, T, 2) px."""
    world_T_cam: FloatArray


def shutter_scene(readout: Readout | None, noise_px: float = 0.0, count: int = 500) -> ShutterScene:
    """Make a scene of ``count`` points around the path of the camera."""
    rng = np.random.default_rng(4)
    points = rng.uniform((-4, -2.5, 2.5), (4, 2.5, 8.0), (count, 3))
    uv, depth, still = (np.empty((count, FRAMES, *end)) for end in ((2,), (), (2,)))
    for t, time in enumerate(TIMES):
        uv[:, t], depth[:, t] = seen(points, float(time), readout)
        still[:, t], _ = seen(points, float(time), None)
    uv += rng.normal(scale=noise_px, size=uv.shape) if noise_px else 0.0
    visible = (depth > 0.5) & (uv >= 0).all(axis=2) & (uv <= (SIZE[1] - 1, SIZE[0] - 1)).all(axis=2)
    visible &= visible.sum(axis=1, keepdims=True) >= 6
    keep = visible.any(axis=1)
    uv, depth, visible, still = uv[keep], depth[keep], visible[keep], still[keep]
    uv[~visible], depth[~visible] = np.nan, np.nan
    kinds = np.zeros(len(uv), np.int32)
    tracks = Tracks(uv.astype(np.float32), visible, visible.argmax(axis=1).astype(np.int32))
    rotation, center = pose(TIMES)
    world_T_cam = np.tile(np.eye(4), (FRAMES, 1, 1))
    world_T_cam[:, :3, :3], world_T_cam[:, :3, 3] = rotation.as_matrix(), center
    labelled = LabelledTracks(tracks, kinds, kinds, visible.astype(np.float32), depth.astype(np.float32))
    return ShutterScene(labelled, still, world_T_cam)
