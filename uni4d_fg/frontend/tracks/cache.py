"""Tracks of a sequence: its own, or remembered ones, or new ones."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from uni4d_fg.config.cues import TrackingConfig
from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.bars import CroppedFrames
from uni4d_fg.frontend.sequence.digest import frames_digest
from uni4d_fg.frontend.sequence.model import Content, Sequence, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.first_views import refines
from uni4d_fg.frontend.tracks.io import load_tracks, save_tracks
from uni4d_fg.frontend.tracks.lucas_kanade import Progress, ShouldStop, track_grid

TRACKER_VERSION = 6
"""Part of the cache key; raised whenever the tracker gives other tracks for the same input."""


def cache_key(images: bytes, config: TrackingConfig) -> str:
    """Return a hexadecimal key that changes with the tracker, its configuration or the hash of the images."""
    settings = f"{TRACKER_VERSION} {refines(config)} {config.model_dump_json()}".encode()
    return hashlib.blake2b(settings + images, digest_size=16).hexdigest()


def load_or_track(
    sequence: Sequence | Video,
    config: TrackingConfig,
    cache_dir: Path | None,
    progress: Progress | None = None,
    should_stop: ShouldStop | None = None,
    save: Callable[[Path, Tracks], None] = save_tracks,
    digest: bytes | None = None,
) -> Tracks:
    """Return the tracks of a sequence, tracking only if there is no other way.

    Args:
        sequence: Its own tracks are used if it brings any.
        config: Built-in tracker.
        cache_dir: Folder of ``tracks-<key>.npz`` files; None remembers nothing. An unreadable file is replaced.
        progress: Told the tracking steps done and to do.
        should_stop: Asked before every step.
        save: Writes new tracks.
        digest: Hash of the images, by :func:`~uni4d_fg.frontend.sequence.digest.frames_digest`; made here when None.

    Raises:
        InputError: If the images cannot be tracked, or the sequence's tracks have another length than it.
        OutputError: If the cache file cannot be written.
        Cancelled: If ``should_stop`` said so.
    """
    if sequence.tracks is not None:
        if sequence.tracks.num_frames != sequence.num_frames:
            raise InputError(
                f"tracks of {sequence.name} cover {sequence.tracks.num_frames} frames, "
                f"the sequence has {sequence.num_frames}"
            )
        return sequence.tracks
    content = sequence.content
    if content is not None and content != Content(0, sequence.image_size[0], 0, sequence.image_size[1]):
        # An edge of a bar looks like a point that stands still: the tracker does not see any.
        inner = replace(sequence, images=CroppedFrames(sequence.images, content), content=None)
        tracks = load_or_track(inner, config, cache_dir, progress, should_stop, save)
        return replace(tracks, uv=tracks.uv + np.array([content.left, content.top], np.float32))
    if cache_dir is None:
        return track_grid(sequence.images, config, progress, should_stop)
    if digest is None:
        digest = frames_digest(sequence.images, should_stop)
    path = cache_dir / f"tracks-{cache_key(digest, config)}.npz"
    remembered = _remembered(path, sequence.num_frames)
    if remembered is not None:
        return remembered
    tracks = track_grid(sequence.images, config, progress, should_stop)
    save(path, tracks)
    return tracks


def _remembered(path: Path, num_frames: int) -> Tracks | None:
    """Return the tracks in a cache file, or None if it is absent or not to be believed."""
    if not path.exists():
        return None
    try:
        tracks = load_tracks(path)
    except InputError:
        return None
    return tracks if tracks.num_frames == num_frames else None
