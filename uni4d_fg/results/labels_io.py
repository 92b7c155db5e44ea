"""Reading and writing of ``labels.npz``: the tracks a run used and what each was taken to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz, save_npz
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel, Tracks

_RANKS = {"uv": 3, "visible": 2, "query_frame": 1, "label": 1, "instance": 1, "weight": 2, "depth": 2}


def save_labels(path: Path, labelled: LabelledTracks) -> None:
    """Write labelled tracks to an ``.npz``, whole or not at all.

    Raises:
        OutputError: If it cannot be written.
    """
    tracks = labelled.tracks
    told = {"confidence": tracks.confidence, "blur_px": tracks.blur_px}
    save_npz(
        path,
        uv=tracks.uv,
        visible=tracks.visible,
        query_frame=tracks.query_frame,
        label=labelled.label,
        instance=labelled.instance,
        weight=labelled.weight,
        depth=labelled.depth,
        **{name: values for name, values in told.items() if values is not None},
    )


def load_labels(path: Path) -> LabelledTracks:
    """Read labelled tracks.

    Raises:
        InputError: If the file is missing or damaged, shapes disagree, or a label is unknown.
    """
    arrays = load_npz(path, _RANKS, {"confidence": 2, "blur_px": 1})
    told = {name: arrays[name].astype(np.float32) for name in ("confidence", "blur_px") if name in arrays}
    for name in ("query_frame", "label", "instance"):
        whole = arrays[name].dtype.kind in "iu" and np.array_equal(arrays[name], arrays[name].astype(np.int32))
        if not whole:
            raise InputError(f"{path}: {name} is not of whole numbers of 32 bits")
    if not (np.isfinite(arrays["weight"]).all() and (arrays["weight"] >= 0).all()):
        raise InputError(f"{path}: weights must be finite and not negative")
    try:
        tracks = Tracks(
            arrays["uv"].astype(np.float32),
            arrays["visible"],
            arrays["query_frame"].astype(np.int32),
            **told,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    shape = tracks.visible.shape
    for name, expected in (("label", shape[:1]), ("instance", shape[:1]), ("weight", shape), ("depth", shape)):
        if arrays[name].shape != expected:
            raise InputError(f"{path}: {name} has shape {arrays[name].shape}, expected {expected}")
    if not np.isin(arrays["label"], [label.value for label in TrackLabel]).all():
        raise InputError(f"{path}: a label is none of {', '.join(f'{n.value} ({n.name})' for n in TrackLabel)}")
    return LabelledTracks(
        tracks,
        arrays["label"].astype(np.int32),
        arrays["instance"].astype(np.int32),
        arrays["weight"].astype(np.float32),
        arrays["depth"].astype(np.float32),
    )
