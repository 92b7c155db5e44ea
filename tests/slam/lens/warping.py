"""A sequence as seen through another lens: what is rendered or recorded with a pinhole, warped.

The focal length grows (barrel) or shrinks so that the corners of the warped frames show real content.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.sequence.model import ArrayFrames, Sequence
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.lens import Lens


@dataclass(frozen=True)
class Warp:
    """From pixels of a pinhole to those of a camera with a lens."""

    pinhole: FloatArray
    """(4,) intrinsics of what is given."""
    intrinsics: FloatArray
    """(4,) those of the warped frames."""
    lens: Lens
    maps: tuple[np.ndarray, np.ndarray]
    """(H, W) twice: where each warped pixel comes from."""

    def frame(self, array: np.ndarray, interpolation: int) -> np.ndarray:
        return cv2.remap(array, *self.maps, interpolation, borderMode=cv2.BORDER_REPLICATE)

    def pixels(self, uv: FloatArray) -> FloatArray:
        plane = (uv - self.pinhole[2:]) / self.pinhole[:2]
        return self.lens.real_pixels(self.intrinsics, plane * self.intrinsics[:2] + self.intrinsics[2:])


def make_warp(pinhole: FloatArray, lens: Lens, size: tuple[int, int]) -> Warp:
    """Return the warp of frames of ``size`` (height, width) whose true intrinsics are given."""
    height, width = size
    corners = np.array([[0.0, 0.0], [width - 1, 0.0], [0.0, height - 1], [width - 1, height - 1]])
    sides = np.array([[pinhole[2], 0.0], [pinhole[2], height - 1], [0.0, pinhole[3]], [width - 1, pinhole[3]]])
    border = np.concatenate([corners, sides])
    moved = lens.real_pixels(pinhole, border)
    # Largest factor by which the border must be pushed out to lie where it was.
    factor = np.max(np.linalg.norm(border - pinhole[2:], axis=1) / np.linalg.norm(moved - pinhole[2:], axis=1))
    intrinsics = pinhole * np.array([factor, factor, 1.0, 1.0])
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    ideal = lens.ideal_pixels(intrinsics, np.stack([u, v], axis=-1).astype(np.float64))
    source = (ideal - intrinsics[2:]) / intrinsics[:2] * pinhole[:2] + pinhole[2:]
    maps = source.astype(np.float32)
    return Warp(pinhole, intrinsics, lens, (maps[..., 0], maps[..., 1]))


def warp_sequence(sequence: Sequence, pinhole: FloatArray, lens: Lens, focal_error: float = 0.0) -> Sequence:
    """Warp images, depth, masks and tracks; the given intrinsics are wrong by ``focal_error``."""
    warp = make_warp(pinhole, lens, sequence.image_size)
    tracks = sequence.tracks
    if tracks is not None:
        height, width = sequence.image_size
        uv = warp.pixels(tracks.uv.astype(np.float64))
        inside = (uv >= 0).all(axis=2) & (uv <= [width - 1, height - 1]).all(axis=2)
        visible = tracks.visible & inside
        uv = np.where(visible[..., None], uv, np.nan).astype(np.float32)
        first = np.argmax(visible, axis=1)
        query = np.where(visible[np.arange(len(visible)), tracks.query_frame], tracks.query_frame, first)
        kept = visible.any(axis=1)
        confidence = None if tracks.confidence is None else tracks.confidence[kept]
        tracks = Tracks(uv[kept], visible[kept], query[kept].astype(np.int32), confidence)
    truth = sequence.ground_truth
    depths = truth.depths
    return replace(
        sequence,
        images=ArrayFrames(np.stack([warp.frame(i, cv2.INTER_LINEAR) for i in sequence.images])),
        depths=ArrayFrames(np.stack([warp.frame(d, cv2.INTER_NEAREST) for d in sequence.depths])),
        masks=ArrayFrames(np.stack([warp.frame(m, cv2.INTER_NEAREST) for m in sequence.masks])),
        intrinsics=warp.intrinsics * np.array([1 + focal_error, 1 + focal_error, 1.0, 1.0]),
        tracks=tracks,
        ground_truth=replace(
            truth,
            intrinsics=warp.intrinsics,
            depths=None
            if depths is None
            else ArrayFrames(np.stack([warp.frame(d, cv2.INTER_NEAREST) for d in depths])),
            track_points=None,
        ),
    )
