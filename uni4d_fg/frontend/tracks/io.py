"""Track files: ``.npz`` with ``uv``, ``visible``, ``query_frame`` and, where known, ``confidence`` and ``blur_px``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz, save_npz
from uni4d_fg.frontend.track_model import Tracks


def save_tracks(path: Path, tracks: Tracks) -> None:
    """Write tracks to an ``.npz`` file, whole or not at all.

    Raises:
        OutputError: If the file cannot be written.
    """
    arrays = {"uv": tracks.uv, "visible": tracks.visible, "query_frame": tracks.query_frame}
    if tracks.confidence is not None:
        arrays["confidence"] = tracks.confidence
    if tracks.blur_px is not None:
        arrays["blur_px"] = tracks.blur_px
    save_npz(path, **arrays)


def load_tracks(path: Path) -> Tracks:
    """Read tracks from an ``.npz`` file.

    ``uv`` (K, T, 2), ``visible`` (K, T; boolean or 0/1), ``query_frame`` (K,) and optionally ``confidence``
    (K, T) and ``blur_px`` (T,); other arrays are ignored. Positions of observations that are not visible become NaN.

    Raises:
        InputError: If the file is unreadable, lacks an array, or the arrays disagree or are out of range.
    """
    arrays = load_npz(path, {"uv": 3, "visible": 2, "query_frame": 1}, {"confidence": 2, "blur_px": 1})
    try:
        uv = arrays["uv"].astype(np.float32)
        visible = arrays["visible"].astype(np.bool_)
        if uv.shape == (*visible.shape, 2):
            uv[~visible] = np.nan
        query_frame = arrays["query_frame"].astype(np.int32)
        confidence = arrays["confidence"].astype(np.float32) if "confidence" in arrays else None
        blur_px = arrays["blur_px"].astype(np.float32) if "blur_px" in arrays else None
        tracks = Tracks(uv, visible, query_frame, confidence, blur_px)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if ((query_frame < 0) | (query_frame >= tracks.num_frames)).any():
        raise InputError(f"{path}: query_frame must lie in [0, {tracks.num_frames})")
    return tracks
