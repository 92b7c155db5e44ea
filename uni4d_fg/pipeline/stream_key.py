"""What a stream's checkpoint belongs to: configuration and selection, and every frame that went into it, bit by bit.

A checkpoint must not go on with other frames than it came from: the map of one scene and the frames of another make a
result that looks whole.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from uni4d_fg.config.models import Config
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.digest import add_array
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.optim.added_factors import FactorSource, fingerprints
from uni4d_fg.pipeline.fingerprint import ALGORITHM_VERSION


class StreamKey:
    """The keys of one stream.

    Args:
        sequence: What is streamed.
        config: The whole configuration.
        sources: What is added to the solves; of these, their fingerprints count.

    Attributes:
        selection: Hexadecimal; changes with the configuration, the calibration, which frames are taken (by their
            times and number) and the tracks, or that there are none.
        consumed: Hexadecimal; changes with any bit of any image, depth map or mask that was taken so far.
    """

    def __init__(self, sequence: Sequence, config: Config, sources: tuple[FactorSource, ...] = ()) -> None:
        self._sequence = sequence
        digest = hashlib.blake2b(config.model_dump_json(exclude={"output", "fusion"}).encode(), digest_size=16)
        digest.update(f"{ALGORITHM_VERSION} {sequence.num_frames} {sequence.image_size}".encode())
        digest.update("".join(fingerprints(sources)).encode())
        if not sequence.lens.is_pinhole:
            digest.update(f"{sequence.lens}".encode())
        tracks = sequence.tracks
        given = () if tracks is None else (tracks.uv, tracks.visible, tracks.query_frame)
        for array in (sequence.intrinsics, sequence.timestamps, *given):
            add_array(digest, array)
        self.selection = digest.hexdigest()
        self.consumed = ""

    def take(self, image: np.ndarray, depth: np.ndarray, mask: np.ndarray) -> None:
        """Add the next frame."""
        digest = hashlib.blake2b(self.consumed.encode(), digest_size=16)
        for array in (image, depth, mask):
            add_array(digest, array)
        self.consumed = digest.hexdigest()

    def check(self, selection: str, consumed: str, frames: int, should_stop: Callable[[], bool] | None) -> None:
        """Read the frames that a checkpoint came from again, and see that they are the same.

        Args:
            selection: That of the checkpoint.
            consumed: That of the checkpoint.
            frames: How many went into it.
            should_stop: Polled before every frame.

        Raises:
            InputError: If anything differs, or a frame cannot be read.
            Cancelled: If ``should_stop`` turned true.
        """
        remedy = "use those again, or start anew with --overwrite"
        if selection != self.selection or frames > self._sequence.num_frames:
            raise InputError(
                f"the checkpoint was written with another configuration, selection of frames, calibration or tracks; "
                f"{remedy}"
            )
        for frame in range(frames):
            if should_stop is not None and should_stop():
                raise Cancelled("stopped while reading the frames again that went into the checkpoint")
            self.take(self._sequence.images[frame], self._sequence.depths[frame], self._sequence.masks[frame])
        if consumed != self.consumed:
            raise InputError(f"the checkpoint was written from other images, depth or masks; {remedy}")
