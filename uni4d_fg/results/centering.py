"""A run cropped so that the principal point is the middle of its images, as some programs take for granted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.frontend.sequence.frames import ChangedFrames
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.results.run import Run


@dataclass(frozen=True)
class Crop:
    """The part of an image that is kept; ``bottom`` and ``right`` are the first row and column behind it."""

    top: int
    bottom: int
    left: int
    right: int

    @classmethod
    def around(cls, cx: float, cy: float, size: tuple[int, int]) -> Crop:
        """Return the largest crop of an image (height, width) whose middle is within half a pixel of (cx, cy)."""
        height, width = size
        left, right = _side(cx, width)
        top, bottom = _side(cy, height)
        return cls(top, bottom, left, right)

    def of(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return this part of an image or map (H, W, ...)."""
        return np.ascontiguousarray(image[self.top : self.bottom, self.left : self.right])


def centered(run: Run) -> tuple[Run, Crop]:
    """Return a run whose principal point is within half a pixel of the middle of its images, and what is kept.

    Pixels are cropped, never interpolated; observations outside of the crop count as not visible.
    """
    result = run.reconstruction
    crop = Crop.around(float(result.intrinsics[2]), float(result.intrinsics[3]), result.image_size)
    size = (crop.bottom - crop.top, crop.right - crop.left)
    if size == result.image_size:
        return run, crop

    def cropped(source: FrameSource[Any]) -> FrameSource[Any]:
        return ChangedFrames(source, lambda values: crop.of(np.asarray(values)))

    shift = np.array([0.0, 0.0, crop.left, crop.top])
    intrinsics = result.intrinsics - shift
    parts: dict[str, Any] = {"reconstruction": replace(result, intrinsics=intrinsics, image_size=size)}
    sequence = run.sequence
    if isinstance(sequence, Sequence):
        parts["sequence"] = replace(
            sequence, images=cropped(sequence.images), depths=cropped(sequence.depths),
            masks=cropped(sequence.masks), intrinsics=sequence.intrinsics - shift, image_size=size,
            tracks=None,
        )  # fmt: skip
    if run.depth is not None:
        parts["depth"] = cropped(run.depth)
    if run.confidence is not None:
        parts["confidence"] = cropped(run.confidence)
    if run.labelled is not None:
        parts["labelled"] = _cropped_tracks(run.labelled, crop)
    return run.with_parts(**parts), crop


def _side(center: float, length: int) -> tuple[int, int]:
    """Return where the kept part of one axis begins and ends; ``center`` has pixel centers at integers."""
    cut = round(2.0 * center - (length - 1))
    return (min(cut, length - 1), length) if cut > 0 else (0, max(length + cut, 1))


def _cropped_tracks(labelled: LabelledTracks, crop: Crop) -> LabelledTracks:
    tracks = labelled.tracks
    uv = tracks.uv - np.array([crop.left, crop.top], dtype=np.float32)
    end = np.array([crop.right - crop.left, crop.bottom - crop.top]) - 0.5
    with np.errstate(invalid="ignore"):
        visible = tracks.visible & ((uv >= -0.5) & (uv < end)).all(axis=2)
    uv[~visible] = np.nan
    weight = np.where(visible, labelled.weight, np.float32(0.0))
    return replace(labelled, tracks=replace(tracks, uv=uv, visible=visible), weight=weight)
