"""A small exact world: static points before a moving camera, as labelled tracks with depth."""

from __future__ import annotations

import dataclasses

import numpy as np

from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel, Tracks
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import project, world_to_camera
from uni4d_fg.slam.stages.observations import Observations, observations_of

K = np.array([200.0, 210.0, 120.0, 90.0])


def camera_path(count: int) -> np.ndarray:
    """Poses (T, 4, 4) on a bent path, the first the identity."""
    t = np.arange(count)
    xi = np.stack([0.01 * np.sin(t), 0.015 * t, 0.0 * t, 0.06 * t, 0.02 * np.sin(0.7 * t), 0.01 * t], axis=1)
    return se3.se3_exp(xi)


def static_points(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform([-1.5, -1.0, 2.5], [2.0, 1.0, 5.0], size=(count, 3))


def observe(
    points: np.ndarray, poses: np.ndarray, label: TrackLabel = TrackLabel.STATIC, instance: int = 0
) -> LabelledTracks:
    """Project points, (K, 3) or moving (K, T, 3), into every frame; nothing is occluded or outside."""
    if points.ndim == 2:
        points = np.repeat(points[:, None], len(poses), axis=1)
    x = world_to_camera(np.broadcast_to(poses, (len(points), *poses.shape)), points)
    uv = np.asarray(project(K, x)).astype(np.float32)
    shape = x.shape[:2]
    tracks = Tracks(uv, np.ones(shape, bool), np.zeros(len(points), np.int32))
    return LabelledTracks(
        tracks,
        np.full(len(points), int(label), np.int32),
        np.full(len(points), instance, np.int32),
        np.ones(shape, np.float32),
        x[..., 2].astype(np.float32),
    )


def hide(labelled: LabelledTracks, hidden: np.ndarray) -> LabelledTracks:
    """Take observations (broadcast to K, T) out."""
    visible = labelled.tracks.visible & ~hidden
    uv = np.where(visible[..., None], labelled.tracks.uv, np.float32(np.nan))
    return dataclasses.replace(
        labelled,
        tracks=Tracks(uv, visible, labelled.tracks.query_frame),
        weight=np.where(visible, labelled.weight, np.float32(0.0)),
        depth=np.where(visible, labelled.depth, np.float32(np.nan)),
    )


def shift(labelled: LabelledTracks, offset: np.ndarray) -> LabelledTracks:
    """Move observations by ``offset`` (broadcast to K, T, 2), px."""
    tracks = labelled.tracks
    moved = Tracks((tracks.uv + offset).astype(np.float32), tracks.visible, tracks.query_frame)
    return dataclasses.replace(labelled, tracks=moved)


def join(*parts: LabelledTracks) -> LabelledTracks:
    """Put several sets of tracks one after the other."""

    def stack(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    def stack_tracks(name: str) -> np.ndarray:
        return np.concatenate([getattr(part.tracks, name) for part in parts])

    tracks = Tracks(stack_tracks("uv"), stack_tracks("visible"), stack_tracks("query_frame"))
    return LabelledTracks(tracks, stack("label"), stack("instance"), stack("weight"), stack("depth"))


def static_observations(labelled: LabelledTracks) -> Observations:
    return observations_of(labelled, TrackLabel.STATIC)
