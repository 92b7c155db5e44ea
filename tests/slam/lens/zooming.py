"""A sequence as a camera that zooms would have seen it: frames cropped about the principal point and made larger."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.track_model import Tracks


def ramp(num_frames: int, last: float = 1.6) -> FloatArray:
    """Return a zoom from 1 to ``last`` (T,): at rest for a fifth of the time, then smooth, then at rest again."""
    s = np.clip((np.linspace(0.0, 1.0, num_frames) - 0.2) / 0.6, 0.0, 1.0)
    return np.exp(np.log(last) * s * s * (3.0 - 2.0 * s))


def zoom_sequence(sequence: Sequence, ratio: FloatArray) -> Sequence:
    """Zoom images, depth, masks and tracks by ``ratio`` (T,), at least 1; intrinsics stay those of a ratio of 1."""
    center = sequence.intrinsics[2:]
    height, width = sequence.image_size

    def frames(source: object, interpolation: int) -> ArrayFrames:
        out = []
        for t, array in enumerate(source):  # type: ignore[arg-type, var-annotated]
            shift = (1.0 - ratio[t]) * center
            matrix = np.array([[ratio[t], 0.0, shift[0]], [0.0, ratio[t], shift[1]]])
            out.append(
                cv2.warpAffine(array, matrix, (width, height), flags=interpolation, borderMode=cv2.BORDER_REPLICATE)
            )
        return ArrayFrames(np.stack(out))

    tracks = sequence.tracks
    if tracks is not None:
        uv = center + (tracks.uv - center) * ratio[None, :, None]
        with np.errstate(invalid="ignore"):
            inside = (uv >= 0).all(axis=2) & (uv <= [width - 1, height - 1]).all(axis=2)
        visible = tracks.visible & inside
        uv = np.where(visible[..., None], uv, np.nan).astype(np.float32)
        kept = visible.any(axis=1)
        first = np.argmax(visible, axis=1)
        query = np.where(visible[np.arange(len(visible)), tracks.query_frame], tracks.query_frame, first)
        confidence = None if tracks.confidence is None else tracks.confidence[kept]
        tracks = Tracks(uv[kept], visible[kept], query[kept].astype(np.int32), confidence)
    truth = sequence.ground_truth
    depths = None if truth.depths is None else frames(truth.depths, cv2.INTER_NEAREST)
    return replace(
        sequence,
        images=frames(sequence.images, cv2.INTER_CUBIC),
        depths=frames(sequence.depths, cv2.INTER_NEAREST),
        masks=frames(sequence.masks, cv2.INTER_NEAREST),
        tracks=tracks,
        ground_truth=replace(truth, depths=depths, track_points=None),
    )
