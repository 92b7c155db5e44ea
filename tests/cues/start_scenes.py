"""Tracks of points seen by a camera on a path, with a thing that moves, for tests of the start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.slam.stages.observations import Observations

SIZE = (240, 320)
K = np.array([260.0, 260.0, 159.5, 119.5])
GUESS = np.array([320.0, 320.0, 159.5, 119.5])


@dataclass(frozen=True)
class TrackedScene:
    """Observations with their truth."""

    observations: Observations
    world_T_cam: np.ndarray
    moves: np.ndarray
    """(K,) which tracks belong to the moving thing."""


def sideways(num_frames: int) -> np.ndarray:
    """A camera that moves to the right and turns, (T, 4, 4)."""
    return camera_path(num_frames, (1.6, 0.1, 0.3), (0.05, -0.3, 0.03))


def forward(num_frames: int) -> np.ndarray:
    """A camera that moves along its axis and hardly turns, (T, 4, 4)."""
    return camera_path(num_frames, (0.0, 0.0, 1.2), (0.0, 0.0, 0.02))


def camera_path(num_frames: int, shift: tuple[float, ...], turn: tuple[float, ...]) -> np.ndarray:
    part = np.linspace(0.0, 1.0, num_frames)
    wobble = np.stack([np.sin(7 * part), np.sin(5 * part + 1), np.sin(6 * part + 2)], axis=1) * 0.02
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    poses[:, :3, :3] = se3.so3_exp(part[:, None] * np.array(turn) + 0.3 * wobble)
    poses[:, :3, 3] = part[:, None] * np.array(shift) + wobble * (np.abs(shift).max() > 0)
    return poses


def observed(rows: list[tuple[np.ndarray, ...]]) -> Observations:
    """Observations of what each frame sees: tracks, frames and pixels, sorted by track and frame, without depth."""
    track, frame, uv = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    order = np.lexsort([frame, track])
    return Observations(
        track[order].astype(np.int64), frame[order].astype(np.int64), uv[order], np.full(len(order), np.nan),
        np.ones(len(order)),
    )  # fmt: skip


def tracked(
    poses: np.ndarray,
    seed: int = 0,
    noise_px: float = 0.3,
    points: int = 700,
    moving: int = 0,
    life: int = 16,
    size: float = 1.0,
) -> TrackedScene:
    """Tracks of a room, and of a thing that the camera follows and that covers the middle of the picture.

    Args:
        poses: (T, 4, 4).
        seed: Of points and noise.
        noise_px: Standard deviation.
        points: Number of points of the room.
        moving: Number of points of the thing.
        size: Of the thing; at 1 it covers 40 % of the picture.
        life: Frames for which a point is followed at most.
    """
    rng = np.random.default_rng(seed)
    num_frames = len(poses)
    room = np.stack([rng.uniform(-4, 5, points), rng.uniform(-2.5, 2.5, points), rng.uniform(2.0, 7.0, points)], axis=1)
    # In the camera: a body that sways and turns as somebody who walks ahead does.
    body = rng.uniform(-0.5, 0.5, (moving, 3)) * np.array([0.72, 0.76, 0.3]) * size
    rows: list[tuple[np.ndarray, ...]] = []
    for frame, pose in enumerate(poses):
        part = frame / max(num_frames - 1, 1)
        uv_room = project(K, world_to_camera(pose, room))
        z_room = world_to_camera(pose, room)[:, 2]
        spin = se3.so3_exp(np.array([0.1 * np.sin(9 * part), 0.5 * part, 0.05 * np.sin(14 * part)]))
        place = body @ spin.T + np.array([0.12 * np.sin(8 * part), 0.05 * np.sin(25 * part), 1.25 - 0.15 * part])
        uv = np.concatenate([uv_room, project(K, place)])
        uv += rng.normal(0, noise_px, uv.shape)
        seen = np.concatenate([z_room > 0.3, place[:, 2] > 0.3])
        seen &= (uv > 0).all(axis=1) & (uv[:, 0] < SIZE[1]) & (uv[:, 1] < SIZE[0])
        if moving:
            low, high = project(K, place).min(axis=0), project(K, place).max(axis=0)
            hidden = ((uv_room > low) & (uv_room < high)).all(axis=1)
            seen[:points] &= ~hidden
        # A track lasts for some frames; then the point is a new track.
        piece = (frame + np.arange(len(uv)) * 7) // life
        track = np.arange(len(uv)) * (num_frames // life + 3) + piece - (np.arange(len(uv)) * 7) // life
        rows.append((track[seen], np.full(seen.sum(), frame), uv[seen], (np.arange(len(uv)) >= points)[seen]))
    track, frame_of, uv, is_moving = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    order = np.lexsort([frame_of, track])
    _, named = np.unique(track[order], return_inverse=True)
    moves = np.zeros(named.max() + 1, dtype=bool)
    moves[named] = is_moving[order]
    nothing = np.full(len(order), np.nan)
    observations = Observations(
        named.astype(np.int64), frame_of[order].astype(np.int64), uv[order], nothing, np.ones(len(order))
    ).with_min_observations(2)
    return TrackedScene(observations, poses, moves)
