"""Synthetic streams with given tracks, and how they are fed and scored."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic import SyntheticSceneConfig, make_synthetic_sequence
from uni4d_fg.slam.incremental import FrameTracks, FrameUpdate, IncrementalReconstructor

SMALL = {
    "height": 120, "width": 160, "focal": 150.0, "margin_px": 3.0, "grid_columns": 20, "grid_rows": 15,
    "render_images": False,
}  # fmt: skip


@functools.cache
def _make(items: tuple[tuple[str, Any], ...]) -> Sequence:
    return make_synthetic_sequence(SyntheticSceneConfig(**dict(items)))


def stream(num_frames: int, **changes: Any) -> Sequence:
    """A small synthetic sequence; each is made once per process."""
    return _make(tuple(({**SMALL, "num_frames": num_frames} | changes).items()))


def stream_config(*overrides: str) -> Config:
    return load_config("default", ["output.clouds=false", "output.pictures=false", *overrides])


def tracks_of(sequence: Sequence, frame: int) -> FrameTracks:
    tracks = sequence.tracks
    assert tracks is not None
    seen = np.flatnonzero(tracks.visible[:, frame])
    return FrameTracks(seen.astype(np.int64), tracks.uv[seen, frame].astype(np.float64))


def no_tracks() -> FrameTracks:
    return FrameTracks(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))


def feed(
    sequence: Sequence,
    config: Config | None = None,
    *,
    frames: list[int] | None = None,
    tracks: Callable[[int], FrameTracks] | None = None,
    depth: Callable[[int], np.ndarray] | None = None,
    mask: Callable[[int], np.ndarray] | None = None,
) -> tuple[IncrementalReconstructor, list[FrameUpdate]]:
    """Add frames one by one, with cues replaced where asked."""
    solver = IncrementalReconstructor(sequence.intrinsics, sequence.image_size, config or stream_config())
    updates = []
    for t in range(sequence.num_frames) if frames is None else frames:
        updates.append(
            solver.add_frame(
                sequence.images[t],
                sequence.depths[t] if depth is None else depth(t),
                sequence.masks[t] if mask is None else mask(t),
                tracks_of(sequence, t) if tracks is None else tracks(t),
                sequence.timestamps[t],
            )
        )
    return solver, updates


def aligned_error(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances (T,) of camera centers after Sim(3) alignment, m."""
    a, b = found[:, :3, 3], truth[:, :3, 3]
    da, db = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(db.T @ da)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / np.sum(da**2)
    return np.linalg.norm(scale * da @ rotation.T - db, axis=1)


def ate(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean(aligned_error(found, truth) ** 2)))


def path_length(poses: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def true_poses(sequence: Sequence) -> np.ndarray:
    poses = sequence.ground_truth.world_T_cam
    assert poses is not None
    return poses
