"""Small sequences and damaged files for the tests of reading, writing and validation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Sequence
from uni4d_fg.frontend.sequence.write import write_native, write_uni4d
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.se3 import se3_exp

FRAMES, HEIGHT, WIDTH, TRACKS = 4, 12, 16, 5


def sample_tracks(rng: np.random.Generator, num_tracks: int = TRACKS, frames: int = FRAMES) -> Tracks:
    visible = rng.random((num_tracks, frames)) < 0.7
    visible[:, 0] = True
    visible[:1] = True
    uv = rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (num_tracks, frames, 2)).astype(np.float32)
    uv[~visible] = np.nan
    query = rng.integers(0, frames, num_tracks).astype(np.int32)
    return Tracks(uv, visible, query, rng.random((num_tracks, frames)).astype(np.float32))


def sample_poses(rng: np.random.Generator, frames: int = FRAMES) -> np.ndarray:
    return se3_exp(rng.normal(0, 0.3, (frames, 6)))


def sample_sequence(
    seed: int = 0,
    frames: int = FRAMES,
    far: bool = False,
    ids: tuple[int, ...] = (0, 1, 7),
    num_tracks: int = TRACKS,
) -> Sequence:
    """A sequence with every field filled; depth is in whole millimeters so that PNG keeps it."""
    rng = np.random.default_rng(seed)
    depth = (rng.integers(500, 4000, (frames, HEIGHT, WIDTH)) / 1000).astype(np.float32)
    if far:
        depth[1, 2, 3] = 70.0
    depth[:, 0, 0] = np.nan
    masks = rng.choice(np.array(ids, dtype=np.int32), (frames, HEIGHT, WIDTH))
    return Sequence(
        name="sample",
        images=ArrayFrames(rng.integers(0, 256, (frames, HEIGHT, WIDTH, 3), dtype=np.uint8)),
        depths=ArrayFrames(depth),
        masks=ArrayFrames(masks),
        intrinsics=np.array([20.0, 20.5, 7.5, 5.5]),
        image_size=(HEIGHT, WIDTH),
        timestamps=np.arange(frames) / 30 + 0.1,
        frame_names=tuple(f"frame_{2 * i:04d}" for i in range(frames)),
        initial_world_T_cam=sample_poses(rng, frames),
        tracks=sample_tracks(rng, num_tracks, frames),
        ground_truth=GroundTruth(
            world_T_cam=sample_poses(rng, frames),
            depths=ArrayFrames(depth[::-1]),
            intrinsics=np.array([21.0, 21.0, 7.0, 5.0]),
            track_points=rng.normal(size=(num_tracks, frames, 3)),
            rigid_instance=np.array([1, 7], dtype=np.int32),
            world_T_object=np.stack([sample_poses(rng, frames) for _ in range(2)]),
        ),
    )


def native_folder(parent: Path, **options: Any) -> Path:
    write_native(sample_sequence(**options), parent / "sample")
    return parent / "sample"


def uni4d_folder(parent: Path, **options: Any) -> Path:
    write_uni4d(sample_sequence(**options), parent / "sample")
    return parent / "sample"


def write_image(path: Path, pixels: np.ndarray) -> None:
    encoded, data = cv2.imencode(path.suffix, pixels)
    assert encoded
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.tobytes())


def cut_file(path: Path, keep: float = 0.5) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def rewrite_npz(path: Path, **changes: Any) -> None:
    """Replace arrays of an .npz file (None removes one), with whatever NumPy accepts."""
    with np.load(path) as archive:
        arrays: dict[str, Any] = dict(archive)
    arrays.update(changes)
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
