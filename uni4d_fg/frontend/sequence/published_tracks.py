"""Track files as the programs that make them save them: CoTracker 2 and 3, TAPIR and BootsTAPIR.

CoTracker saves ``pred_tracks`` (1, T, N, 2) or (T, N, 2) in px, and ``pred_visibility`` (1, T, N) or (1, T, N, 1),
booleans or probabilities. TAPIR and BootsTAPIR save ``tracks`` (N, T, 2) in px, and ``visibles`` or ``occluded``
(N, T), or the logits ``occlusion`` and ``expected_dist`` (N, T).

CoTracker may add ``pred_confidence`` and ``queries`` (N, 3: frame, x, y), TAPIR ``query_points`` (N, 3: frame, y, x).
Either may add ``image_size`` (height, width): that of the images the positions belong to.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of
from uni4d_fg.frontend.sequence.raw_tracks import RawTracks

Arrays = Mapping[str, npt.NDArray[Any]]

POSITIONS = ("pred_tracks", "tracks")
_SEEN = ("pred_visibility", "pred_visibilities", "visibles", "visibility", "visible", "vis")
_OCCLUDED = ("occluded",)
_OCCLUSION_LOGITS = ("occlusion", "occlusions", "occlusion_logits")
_CONFIDENCE = ("pred_confidence", "confidence")
_QUERIES = ("queries", "query_points")
_SIZES = ("image_size", "orig_shape")
_TAPIR_ONLY = (*_OCCLUDED, *_OCCLUSION_LOGITS, "visibles", "query_points", "expected_dist")

_SEEN_FROM = 0.5


def is_published_form(names: set[str]) -> bool:
    """Tell whether an ``.npz`` with these arrays holds tracks as CoTracker or TAPIR save them."""
    seen = (*_SEEN, *_OCCLUDED, *_OCCLUSION_LOGITS)
    return any(name in names for name in POSITIONS) and any(name in names for name in seen)


def read_published(path: Path, arrays: Arrays, num_frames: int | None = None) -> RawTracks:
    """Bring tracks of CoTracker, TAPIR or BootsTAPIR into one order.

    Args:
        path: The file, for messages.
        arrays: What is in it.
        num_frames: T, where known: it settles which axis is time if the names leave it open.

    Raises:
        InputError: If shapes do not go together or there is more than one video in the file.
    """
    name = next(name for name in POSITIONS if name in arrays)
    uv = _one_video(path, name, arrays[name], 3)
    if uv.ndim != 3 or uv.shape[2] != 2:
        raise SequenceProblem(path, f"{name} has shape {arrays[name].shape}", "save positions (T, N, 2) or (N, T, 2)")
    time_first = _time_first(name, arrays, uv.shape[:2], num_frames)
    seen = _seen(path, arrays, uv.shape[:2])
    confidence_name = next((n for n in _CONFIDENCE if n in arrays), None)
    confidence = None if confidence_name is None else _per_point(path, confidence_name, arrays, uv.shape[:2])
    if time_first:
        uv, seen = uv.swapaxes(0, 1), seen.T
        confidence = None if confidence is None else confidence.T
    query_name = next((n for n in _QUERIES if n in arrays), None)
    query = None
    if query_name is not None:
        queries = _one_video(path, query_name, arrays[query_name], 2)
        if queries.shape != (len(uv), 3):
            raise SequenceProblem(
                path, f"{query_name} has shape {queries.shape}", f"save one query for each of {len(uv)} tracks, or none"
            )
        query = np.rint(queries[:, 0])
    size_name = next((n for n in _SIZES if n in arrays), None)
    size = None
    if size_name is not None:
        values = arrays[size_name].reshape(-1)
        if len(values) < 2:
            raise SequenceProblem(path, f"{size_name} has shape {arrays[size_name].shape}", "save (height, width)")
        size = (int(values[0]), int(values[1]))
    return RawTracks(path, uv, seen, query, confidence, size)


def _time_first(name: str, arrays: Arrays, shape: tuple[int, ...], num_frames: int | None) -> bool:
    """Tell which axis is time: by the length of the video if only one fits, else by whose names these are."""
    if num_frames is not None and (shape[0] == num_frames) != (shape[1] == num_frames):
        return shape[0] == num_frames
    return name == "pred_tracks" or not any(other in arrays for other in _TAPIR_ONLY)


def _seen(path: Path, arrays: Arrays, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    for name in _SEEN:
        if name in arrays:
            values = _per_point(path, name, arrays, shape)
            return values if values.dtype == np.bool_ else values > _SEEN_FROM
    for name in _OCCLUDED:
        if name in arrays:
            return ~(_per_point(path, name, arrays, shape) > _SEEN_FROM)
    name = next(n for n in _OCCLUSION_LOGITS if n in arrays)
    values = arrays[name]
    if values.dtype == np.bool_:
        return ~_per_point(path, name, arrays, shape).astype(bool)
    probability = _falling(_per_point(path, name, arrays, shape))
    if "expected_dist" in arrays:
        probability = probability * _falling(_per_point(path, "expected_dist", arrays, shape))
    return np.asarray(probability > _SEEN_FROM)


def _falling(logit: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return one minus the sigmoid."""
    return np.asarray(1 / (1 + np.exp(np.clip(logit.astype(np.float64), -80, 80))))


def _per_point(path: Path, name: str, arrays: Arrays, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    values = arrays[name]
    if values.ndim > 2 and values.shape[-1] == 1:
        values = values[..., 0]
    values = _one_video(path, name, values, 2)
    if values.shape != shape:
        raise SequenceProblem(
            path, f"{name} has shape {arrays[name].shape}, but there are positions {shape}", "save one per position"
        )
    return values


def _one_video(path: Path, name: str, values: npt.NDArray[Any], ndim: int) -> npt.NDArray[Any]:
    """Drop the axis of the batch."""
    if values.dtype.kind not in "biuf":
        raise SequenceProblem(path, f"{name} holds {values.dtype} instead of numbers", "save plain arrays")
    if values.ndim == ndim + 1:
        if values.shape[0] != 1:
            raise SequenceProblem(path, f"{name} holds {values.shape[0]} videos", "save one video per file")
        return np.asarray(values[0])
    return values


def known_forms(names: set[str]) -> str:
    """Return what was found and what is taken, for messages."""
    found = some_of(sorted(names)) or "nothing"
    return f"holds {found}; needed are uv, visible, query_frame, or the arrays of CoTracker, TAPIR or Uni4D"
