"""Point tracks on disk: the native ``tracks.npz``, those of Uni4D's layout, and those of the trackers themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.sequence.published_tracks import POSITIONS, is_published_form, known_forms, read_published
from uni4d_fg.frontend.sequence.raw_tracks import RawTracks

__all__ = ["RawTracks", "load_native_tracks", "load_track_file", "load_uni4d_tracks"]


def load_track_file(path: Path, num_frames: int | None = None) -> RawTracks:
    """Read tracks in any of the known forms.

    Args:
        path: ``.npz`` file: native, Uni4D's, or as CoTracker, TAPIR or BootsTAPIR save them.
        num_frames: Length of the video, where known.

    Raises:
        InputError: If the file cannot be read or is of no known form.
    """
    arrays = load_npz(path, {}, check=_spans(path, num_frames))
    names = set(arrays)
    if "uv" in names:
        return load_native_tracks(path, num_frames)
    if "all_tracks" in names:
        return load_uni4d_tracks(path, num_frames)
    if is_published_form(names):
        return read_published(path, arrays, num_frames)
    raise SequenceProblem(path, known_forms(names), "save the tracks in one of these forms")


def load_native_tracks(path: Path, num_frames: int | None = None) -> RawTracks:
    """Read ``tracks.npz``: uv (K, T, 2), visible (K, T), query_frame (K,), optional confidence (K, T).

    What CoTracker, TAPIR or BootsTAPIR saved is understood in its place. With ``num_frames``, arrays of another length
    are refused by their headers.

    Raises:
        InputError: If the file cannot be read, or an array is missing or has another rank.
    """
    try:
        arrays = load_npz(path, {"uv": 3, "visible": 2, "query_frame": 1}, {"confidence": 2}, _spans(path, num_frames))
    except InputError:
        published = _published(path, num_frames)
        if published is None:
            raise
        return published
    return RawTracks(path, arrays["uv"], arrays["visible"], arrays["query_frame"], arrays.get("confidence"))


def load_uni4d_tracks(path: Path, num_frames: int | None = None) -> RawTracks:
    """Read CoTracker's ``results.npz`` or the ``filtered_results.npz`` that Uni4D makes of it.

    The first holds ``all_tracks`` (T, K, 2), ``all_visibilities`` (T, K) and, if any, ``all_confidences``
    (T, K), ``init_frames`` (K,) and ``orig_shape`` (2,); the second ``tracks`` (T, K, 2) and ``vis`` (T, K).

    Raises:
        InputError: If the file cannot be read, or an array is missing or has another rank.
    """
    if path.name.startswith("filtered"):
        arrays = load_npz(path, {"tracks": 3, "vis": 2}, {}, _spans(path, num_frames))
        return RawTracks(path, arrays["tracks"].swapaxes(0, 1), arrays["vis"].T, None)
    arrays = load_npz(
        path,
        {"all_tracks": 3, "all_visibilities": 2},
        {"all_confidences": 2, "init_frames": 1, "orig_shape": 1},
        _spans(path, num_frames),
    )
    confidence = arrays.get("all_confidences")
    size = arrays.get("orig_shape")
    return RawTracks(
        path,
        arrays["all_tracks"].swapaxes(0, 1),
        arrays["all_visibilities"].T,
        arrays.get("init_frames"),
        None if confidence is None else confidence.T,
        (int(size[0]), int(size[1])) if size is not None and size.shape[0] >= 2 else None,
    )


def _spans(path: Path, num_frames: int | None) -> Callable[[dict[str, tuple[int, ...]]], None]:
    """Return a check of the headers: an array of positions must have as many frames as the video."""

    def check(shapes: dict[str, tuple[int, ...]]) -> None:
        for name in ("uv", "all_tracks", *POSITIONS):
            shape = shapes.get(name, ())
            if len(shape) < 3 or num_frames is None or num_frames in shape[:-1]:
                continue
            found = (
                shape[1] if name == "uv" else shape[0] if name == "all_tracks" else " or ".join(map(str, shape[:-1]))
            )
            raise SequenceProblem(
                path,
                f"tracks span {found} frames, but the video has {num_frames}",
                "track the same frames that are in the sequence",
            )

    return check


def _published(path: Path, num_frames: int | None) -> RawTracks | None:
    """Return the tracks of a file in a tracker's own form, or None."""
    try:
        arrays = load_npz(path, {}, check=_spans(path, num_frames))
    except InputError:
        return None
    return read_published(path, arrays) if is_published_form(set(arrays)) and "uv" not in arrays else None
