"""Tracks as a file holds them, and what must hold before they are believed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Int32Array
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.track_model import Tracks

_CONFIDENCE_ROUNDING = 1e-3
_MAX_MISPLACED = 0.2
"""Share of visible observations outside the image: trackers leave a few there; swapped axes, a quarter and more."""
_REACH = 1.0
"""Normalized positions are below it, whether they begin at 0 or at its negative."""


@dataclass(frozen=True)
class RawTracks:
    """Tracks as a file holds them, before anything is checked against the video."""

    path: Path
    uv: npt.NDArray[Any]
    """(K, T, 2) pixels."""
    visible: npt.NDArray[Any]
    """(K, T), true or 1 where visible."""
    query_frame: npt.NDArray[Any] | None
    """(K,); None when the file does not say, which means the first frame in which the track is visible."""
    confidence: npt.NDArray[Any] | None = None
    """(K, T) in [0, 1]."""
    image_size: tuple[int, int] | None = None
    """(height, width) of the images the tracks were made on, when the file says so."""

    def problems(self, num_frames: int, size: tuple[int, int]) -> list[SequenceProblem]:
        """Return everything that keeps these from being tracks of a video of that length and image size."""
        shapes = self._shape_problems(num_frames)
        return shapes if shapes else self._value_problems(num_frames, size)

    def _shape_problems(self, num_frames: int) -> list[SequenceProblem]:
        remedy = "save uv (K, T, 2), visible (K, T), query_frame (K,) and, if any, confidence (K, T)"
        shape = self.visible.shape
        optional = {"query_frame": (self.query_frame, shape[:1]), "confidence": (self.confidence, shape)}
        found = [
            SequenceProblem(self.path, f"{name} has shape {array.shape} but visible has {shape}", remedy)
            for name, (array, expected) in optional.items()
            if array is not None and array.shape != expected
        ]
        if self.uv.shape != (*shape, 2):
            found.append(SequenceProblem(self.path, f"uv has shape {self.uv.shape} but visible has {shape}", remedy))
        elif shape[1] != num_frames:
            found.append(
                SequenceProblem(
                    self.path,
                    f"tracks span {shape[1]} frames, but the video has {num_frames}",
                    "track the same frames that are in the sequence",
                )
            )
        return found

    def _value_problems(self, num_frames: int, size: tuple[int, int]) -> list[SequenceProblem]:
        found = []

        def add(what: str, remedy: str) -> None:
            found.append(SequenceProblem(self.path, what, remedy))

        if not ((self.visible == 0) | (self.visible == 1)).all():
            add("visible has values other than 0 and 1", "threshold the visibility and save booleans")
        seen = self.visible == 1
        broken = seen & ~np.isfinite(self.uv).all(axis=2)
        if broken.any():
            track, frame = (int(i) for i in np.argwhere(broken)[0])
            add(
                f"{int(broken.sum())} visible observations are NaN or infinite (first: track {track}, frame {frame})",
                "mark them not visible",
            )
        query = self.query_frame
        if query is not None and not ((query >= 0) & (query < num_frames) & (query == np.floor(query))).all():
            add(f"query_frame has values that are not frames 0 to {num_frames - 1}", "save frame indices")
        if self.confidence is not None:
            with np.errstate(invalid="ignore"):
                outside = (self.confidence < -_CONFIDENCE_ROUNDING) | (self.confidence > 1 + _CONFIDENCE_ROUNDING)
            if outside.any():
                add("confidence has values outside [0, 1]", "scale it to [0, 1] or leave it out")
        if self.image_size is not None and self.image_size != size:
            add(
                f"tracks were made on images of {self.image_size[1]} x {self.image_size[0]} px, "
                f"but these have {size[1]} x {size[0]} px",
                "track the images that are in the sequence",
            )
        elif (misplaced := misplacement(self.uv, seen, size)) is not None:
            add(*misplaced)
        return found

    def outside(self, size: tuple[int, int]) -> BoolArray:
        """Return (K, T) True where a visible observation lies outside an image of ``size`` (height, width)."""
        return _outside(self.uv, self.visible == 1, size)

    def to_tracks(self, num_frames: int, size: tuple[int, int]) -> Tracks:
        """Return checked tracks: visible where the file says so and inside the image, NaN elsewhere.

        Raises:
            InputError: The first of :meth:`problems`.
        """
        for problem in self.problems(num_frames, size):
            raise problem
        visible: BoolArray = (self.visible == 1) & ~self.outside(size)
        uv = np.where(visible[..., None], self.uv, np.nan).astype(np.float32, copy=False)
        query: Int32Array
        if self.query_frame is not None:
            query = self.query_frame.astype(np.int32)
        else:
            query = visible.argmax(axis=1).astype(np.int32)
        confidence = None
        if self.confidence is not None:
            confidence = np.clip(np.nan_to_num(self.confidence, nan=0.0), 0, 1).astype(np.float32)
        return Tracks(uv, visible, query, confidence)


def misplacement(uv: npt.NDArray[Any], visible: BoolArray, size: tuple[int, int]) -> tuple[str, str] | None:
    """Say what shows that positions are not pixels of the images, and the remedy, or return None.

    Args:
        uv: (K, T, 2) positions.
        visible: (K, T).
        size: (height, width) of the images, px.
    """
    normalized = normalization(uv, visible, size)
    if normalized is not None:
        return normalized
    share = int(_outside(uv, visible, size).sum()) / max(int(visible.sum()), 1)
    if share <= _MAX_MISPLACED:
        return None
    return (
        f"{100 * share:.0f} % of the visible observations lie outside the image of {size[1]} x {size[0]} px",
        "check that the tracks were made on images of this size, as (x, y); mark what left the image not visible",
    )


def normalization(uv: npt.NDArray[Any], visible: BoolArray, size: tuple[int, int]) -> tuple[str, str] | None:
    """Say that positions are normalized, and the remedy, or return None; arguments as of :func:`misplacement`."""
    with np.errstate(invalid="ignore"):
        near = int((visible & ((uv >= -_REACH) & (uv < _REACH)).all(axis=2)).sum())
    share = near / max(int(visible.sum()), 1)
    if share <= 1.0 - _MAX_MISPLACED:
        return None
    return (
        f"{100 * share:.0f} % of the visible observations lie within the first pixel, as normalized ones do",
        f"give pixels: x from 0 to {size[1] - 1}, y from 0 to {size[0] - 1}",
    )


def _outside(uv: npt.NDArray[Any], visible: BoolArray, size: tuple[int, int]) -> BoolArray:
    """Return (K, T) True where a visible observation of finite position lies outside the image."""
    with np.errstate(invalid="ignore"):
        x, y = uv[..., 0], uv[..., 1]
        inside = (x >= 0) & (x < size[1]) & (y >= 0) & (y < size[0])
    result: BoolArray = visible & np.isfinite(x) & np.isfinite(y) & ~inside
    return result
