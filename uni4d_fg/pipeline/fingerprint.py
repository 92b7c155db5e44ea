"""Hashes that say whether a stage's stored result still belongs to its inputs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from uni4d_fg.frontend.sequence.digest import add_array, frames_digest
from uni4d_fg.frontend.sequence.frame_checks import checked_image, checked_mask, floating_depth
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.optim.threads import map_in_order, thread_count

_Check = Callable[[Any, tuple[int, int], str], np.ndarray]
_CHECKS: dict[str, _Check] = {"image": checked_image, "depth": floating_depth, "mask": checked_mask}

ALGORITHM_VERSION = 31
"""Part of every key; raised whenever a stage gives another result for the same input and configuration."""


class SequenceDigest(NamedTuple):
    """Hashes of a sequence."""

    key: str
    """Of all that it holds."""
    images: bytes
    """Of its images alone."""


def sequence_digest(sequence: Sequence, should_stop: Callable[[], bool] | None = None) -> SequenceDigest:
    """Hash every image, depth map and mask, the calibration, poses and tracks; frames one at a time.

    Raises:
        Cancelled: If ``should_stop`` said so.
        InputError: If a frame cannot be read or has another size than the sequence.
    """

    def hashed(named: tuple[str, FrameSource[Any]]) -> bytes:
        name, source = named

        def check(array: Any, frame: int) -> None:
            # Sources of the caller's own may hold anything; what comes after relies on shapes and types.
            _CHECKS[name](array, sequence.image_size, f"sequence {sequence.name}: {name} of frame {frame}")

        return frames_digest(source, should_stop, check)

    # Side by side, but each in order and by one thread: a video is decoded forwards.
    sources = [("image", sequence.images), ("depth", sequence.depths), ("mask", sequence.masks)]
    found = map_in_order(hashed, sources, thread_count())
    digest = hashlib.blake2b(b"".join(found), digest_size=16)
    if sequence.masks_from_motion:
        digest.update(b"masks from motion")
    add_array(digest, sequence.intrinsics)
    if not sequence.lens.is_pinhole:
        digest.update(sequence.lens.model.encode())
        add_array(digest, sequence.lens.padded)
    if sequence.zoom is not None:
        add_array(digest, sequence.zoom)
    add_array(digest, sequence.timestamps)
    if sequence.initial_world_T_cam is not None:
        add_array(digest, sequence.initial_world_T_cam)
    if sequence.tracks is not None:
        for values in (sequence.tracks.uv, sequence.tracks.visible, sequence.tracks.query_frame):
            add_array(digest, values)
    return SequenceDigest(digest.hexdigest(), found[0])


def stage_key(previous: str, *sections: Any) -> str:
    """Hash the key of what a stage builds on together with the configuration it reads."""
    digest = hashlib.blake2b(f"{ALGORITHM_VERSION} {previous}".encode(), digest_size=16)
    for section in sections:
        data = section.model_dump(mode="json") if hasattr(section, "model_dump") else section
        digest.update(json.dumps(data, sort_keys=True).encode())
    return digest.hexdigest()
