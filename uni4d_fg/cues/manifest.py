"""What was made of a video's cues, so that they can be opened again without making them."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, FiniteFloat, ValidationError

from uni4d_fg.cues.cache import FloatMaps
from uni4d_fg.cues.plan import GUESSED, CuePlan, CueReport
from uni4d_fg.errors import InputError
from uni4d_fg.files import atomic_write_json, save_npy
from uni4d_fg.frontend.sequence.assemble import as_sequence, check_count
from uni4d_fg.frontend.sequence.frames import FileFrames, MaskFolder, no_masks
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.frontend.sequence.poses import load_poses
from uni4d_fg.frontend.tracks.io import load_tracks, save_tracks
from uni4d_fg.geometry.lens import Lens, LensModel
from uni4d_fg.reading import check_regular, read_json

MANIFEST = "cues.json"
_FORMAT = 1
_POSES = "initial_world_T_cam"
_MAX_BYTES = 256 * 1024**2


class _Report(BaseModel):
    sources: dict[str, str] = {}
    facts: list[str] = []
    warnings: list[str] = []
    metric: bool = True
    start: dict[str, Any] = {}


class Manifest(BaseModel):
    """What :func:`save_manifest` writes, as far as it is read; names are relative to the folder."""

    num_frames: int
    image_size: tuple[int, int]
    depth: list[str] | None
    masks: list[str] | None
    static: bool
    tracks: str | None
    intrinsics: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    lens: tuple[LensModel, tuple[FiniteFloat, ...]] = ("PINHOLE", ())
    zoom: list[FiniteFloat] | None = None
    initial_world_T_cam: str | None
    report: _Report


def save_manifest(
    folder: Path, video: Video, sequence: Sequence, plan: CuePlan, report: CueReport, track_file: Path | None
) -> None:
    """Write down which files of ``folder`` are the cues of a video.

    Raises:
        OutputError: If it cannot be written.
    """
    if sequence.tracks is not None and video.tracks is not sequence.tracks and track_file is None:
        track_file = folder / "tracks.npz"
        save_tracks(track_file, sequence.tracks)
    made_tracks = sequence.tracks is not None and video.tracks is not sequence.tracks
    atomic_write_json(
        folder / MANIFEST,
        {
            "format": _FORMAT,
            "num_frames": video.num_frames,
            "image_size": list(video.image_size),
            "plan": asdict(plan),
            "depth": _files(sequence.depths, folder) if plan.depth != "given" else None,
            "masks": _files(sequence.masks, folder) if plan.masks not in ("given", "none") else None,
            "static": plan.masks == "none",
            "tracks": _relative(track_file, folder) if made_tracks and track_file is not None else None,
            "intrinsics": sequence.intrinsics.tolist(),
            "lens": [sequence.lens.model, list(sequence.lens.parameters)],
            "zoom": None if sequence.zoom is None else sequence.zoom.tolist(),
            _POSES: _poses(sequence, video, folder),
            "report": report.to_dict(),
        },
    )


def has_manifest(folder: Path) -> bool:
    """Tell whether ``folder`` holds cues."""
    return (folder / MANIFEST).is_file()


def read_manifest(folder: Path) -> Manifest:
    """Read which files of ``folder`` are cues. Raises InputError if it cannot be read, or is of another form."""
    path = folder / MANIFEST
    try:
        return Manifest.model_validate(read_json(path, _MAX_BYTES))
    except (ValidationError, RecursionError) as error:
        what = str(error)
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False)[0]
            what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise InputError(f"{path}: does not say what the cues are ({what}); make them again with --resume") from error


def load_cues(video: Video, folder: Path) -> tuple[Sequence, CueReport]:
    """Open the cues that were made of a video.

    Args:
        video: As it was when they were made.
        folder: That of :func:`~uni4d_fg.cues.gather.gather_cues`.

    Raises:
        InputError: If they are not all there, or are those of another video.
    """
    stored, path = read_manifest(folder), folder / MANIFEST
    if stored.num_frames != video.num_frames or stored.image_size != video.image_size:
        raise InputError(
            f"{path}: cues of {stored.num_frames} frames of {list(stored.image_size)} px, but {video.name} has "
            f"{video.num_frames} of {list(video.image_size)}; was the video replaced? Make the cues again"
        )
    changes: dict[str, Any] = {"depth_is_metric": stored.report.metric}
    guessed = stored.report.sources.get("intrinsics") == GUESSED
    changes["intrinsics"] = None if guessed else np.array(stored.intrinsics)  # the same guess is made of None
    changes["lens"] = Lens(*stored.lens)
    if stored.zoom is not None:
        check_count(path, len(stored.zoom), video.num_frames)
        changes["zoom"] = np.array(stored.zoom)
    if stored.depth is not None:
        changes["depths"] = FloatMaps(_paths(stored.depth, folder, video), video.image_size)
    if stored.masks is not None:
        changes["masks"] = MaskFolder(_paths(stored.masks, folder, video), video.image_size)
    elif stored.static:
        changes["masks"] = no_masks(video.image_size, video.num_frames)
    if stored.tracks is not None:
        tracks = load_tracks(folder / stored.tracks)
        check_count(folder / stored.tracks, tracks.num_frames, video.num_frames)
        changes["tracks"] = tracks
    if stored.initial_world_T_cam is not None:
        changes[_POSES] = load_poses(folder / stored.initial_world_T_cam, video.num_frames)
    report = CueReport(
        stored.report.sources, stored.report.facts, stored.report.warnings, stored.report.metric, stored.report.start
    )
    return as_sequence(replace(video, **changes)), report


def _poses(sequence: Sequence, video: Video, folder: Path) -> str | None:
    """Store the poses that were found with the cues; None without any."""
    poses = sequence.initial_world_T_cam
    if poses is None or poses is video.initial_world_T_cam:
        return None
    save_npy(folder / f"{_POSES}.npy", poses)
    return f"{_POSES}.npy"


def _files(frames: FrameSource[Any], folder: Path) -> list[str]:
    assert isinstance(frames, FileFrames)
    return [_relative(path, folder) for path in frames.paths]


def _relative(path: Path, folder: Path) -> str:
    return os.path.relpath(path, folder)


def _paths(names: list[str], folder: Path, video: Video) -> tuple[Path, ...]:
    check_count(folder / MANIFEST, len(names), video.num_frames)
    paths = tuple(folder / name for name in names)
    for path in paths:
        try:
            check_regular(path)
        except InputError as error:
            raise InputError(f"{error}; a cue of this run is no longer there: make it again with --resume") from error
    return paths
