"""An endless stream: a camera in a large hall, whose frames are made one by one and kept nowhere.

The hall is a box seen from inside, so that nothing occludes anything and depth is one formula per pixel. The
camera goes round on a closed curve, with a slight tremor, looking ahead and to the side. Every few frames new
tracks are started on the walls; each ends when it leaves the image or is old. Memory does not grow with the
number of frames, which makes the stream fit to measure that of a program.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray, Int32Array, IntArray
from uni4d_fg.config.base import Section, setting
from uni4d_fg.frontend.synthetic.camera_path import look_at
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera

_HALF_SIZE = np.array([6.0, 2.0, 6.0])
_RADIUS_M = 2.5


class HallConfig(Section):
    """What a hall stream depends on."""

    num_frames: int = setting(1000, "Number of frames.", ge=1)
    height: int = setting(480, "Image height, px.", ge=16)
    width: int = setting(640, "Image width, px.", ge=16)
    focal: float = setting(520.0, "Focal length, px.", gt=0)
    speed: float = setting(0.03, "Length of the camera's path per frame, m.", ge=0)
    new_tracks: int = setting(400, "Tracks started at a time.", ge=1)
    query_interval: int = setting(10, "Frames between starts.", ge=1)
    track_life: int = setting(50, "Frames after which a track is lost at the latest.", ge=2)
    track_sigma_px: float = setting(0.5, "Noise of each track coordinate, px.", ge=0)
    outlier_fraction: float = setting(0.02, "Part of the observations that are displaced by up to 20 px.", ge=0, le=1)
    depth_flicker: float = setting(0.04, "Standard deviation of each frame's depth log-scale.", ge=0)
    depth_pixel: float = setting(0.01, "Standard deviation of each pixel's relative depth error.", ge=0)
    focal_error: float = setting(0.03, "The given focal length is too long by this part.", gt=-0.9, le=1)
    seed: int = setting(0, "Seed of the noise.", ge=0)


@dataclass(frozen=True)
class HallFrame:
    """One frame and its cues."""

    image: ImageArray
    """(H, W, 3) flat gray."""
    depth: Float32Array
    """(H, W) noisy cue, m."""
    mask: Int32Array
    """(H, W) zeros."""
    track: IntArray
    """(n,) numbers of the tracks seen."""
    uv: FloatArray
    """(n, 2) px, noisy."""
    world_T_cam: FloatArray
    """(4, 4) truth."""


def hall_poses(config: HallConfig) -> FloatArray:
    """Return the true poses (T, 4, 4); the first is not the identity."""
    t = np.arange(config.num_frames)
    angle = config.speed / _RADIUS_M * t
    position = np.stack([_RADIUS_M * np.cos(angle), 0.15 * np.sin(2.3 * angle), _RADIUS_M * np.sin(angle)], axis=1)
    position += 0.003 * np.stack([np.sin(0.9 * t), np.sin(1.3 * t + 1.0), np.sin(0.7 * t + 2.0)], axis=1)
    ahead = angle + 0.9
    target = np.stack([6.0 * np.cos(ahead), 0.3 * np.sin(0.05 * t), 6.0 * np.sin(ahead)], axis=1)
    return look_at(position, target, 0.02 * np.sin(0.11 * t))


def hall_frames(config: HallConfig) -> Iterator[HallFrame]:
    """Yield the frames one by one."""
    rng = np.random.default_rng(config.seed)
    size = (config.height, config.width)
    intrinsics = hall_intrinsics(config)
    v, u = np.meshgrid(np.arange(config.height), np.arange(config.width), indexing="ij")
    rays = np.asarray(unproject(intrinsics, np.stack([u, v], axis=-1).astype(np.float64), np.ones(size)))
    image = np.full((*size, 3), 128, dtype=np.uint8)
    mask = np.zeros(size, dtype=np.int32)
    track, born, points, following = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 3)), 0
    for t, pose in enumerate(hall_poses(config)):
        true_depth = _depth(pose, rays)
        uv, seen = _seen(points, pose, intrinsics, size)
        alive = seen & (t - born < config.track_life)
        track, born, points, uv = track[alive], born[alive], points[alive], uv[alive]
        if t % config.query_interval == 0:
            new = np.stack([rng.uniform(8, s - 9, config.new_tracks) for s in (config.width, config.height)], axis=1)
            ray = np.asarray(unproject(intrinsics, new, np.ones(config.new_tracks)))
            x = ray * _depth(pose, ray)[:, None]
            points = np.concatenate([points, camera_to_world(np.broadcast_to(pose, (len(x), 4, 4)), x)])
            track = np.concatenate([track, following + np.arange(config.new_tracks)])
            born = np.concatenate([born, np.full(config.new_tracks, t)])
            uv = np.concatenate([uv, new])
            following += config.new_tracks
        noisy = uv + config.track_sigma_px * rng.standard_normal(uv.shape)
        displaced = rng.random(len(uv)) < config.outlier_fraction
        noisy[displaced] += rng.uniform(-20.0, 20.0, size=(int(displaced.sum()), 2))
        noisy = np.clip(noisy, 0.0, (config.width - 1, config.height - 1))
        error = config.depth_flicker * rng.standard_normal() + config.depth_pixel * rng.standard_normal(size)
        yield HallFrame(image, (true_depth * np.exp(error)).astype(np.float32), mask, track.copy(), noisy, pose)


def hall_intrinsics(config: HallConfig) -> FloatArray:
    """Return the true intrinsics (4,), px."""
    return np.array([config.focal, config.focal, 0.5 * (config.width - 1), 0.5 * (config.height - 1)])


def given_intrinsics(config: HallConfig) -> FloatArray:
    """Return the intrinsics (4,) that a reconstruction starts from, px."""
    result: FloatArray = hall_intrinsics(config) * np.array([1.0 + config.focal_error] * 2 + [1.0, 1.0])
    return result


def _depth(world_T_cam: FloatArray, rays: FloatArray) -> FloatArray:
    """Return the z-depth of the walls along camera-frame rays (..., 3) of unit z."""
    direction = rays @ world_T_cam[:3, :3].T
    with np.errstate(divide="ignore"):
        distance = (np.sign(direction) * _HALF_SIZE - world_T_cam[:3, 3]) / direction
    result: FloatArray = np.where(direction == 0.0, np.inf, distance).min(axis=-1)
    return result


def _seen(
    points: FloatArray, pose: FloatArray, intrinsics: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, np.ndarray]:
    x = world_to_camera(np.broadcast_to(pose, (len(points), 4, 4)), points)
    uv = np.asarray(project(intrinsics, x))
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] <= size[1] - 1) & (uv[:, 1] <= size[0] - 1)
    return uv, inside & (x[:, 2] > 0.1)
