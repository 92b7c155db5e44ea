"""What was made of a video's cues, so that they can be opened again without making them."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.cues.cache import FloatMaps
from uni4d_fg.cues.plan import CuePlan, CueReport
from uni4d_fg.errors import InputError
from uni4d_fg.files import atomic_write_json, load_npy, save_npy
from uni4d_fg.frontend.sequence.assemble import as_sequence
from uni4d_fg.frontend.sequence.frames import FileFrames, MaskFolder, no_masks
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.frontend.tracks.io import load_tracks, save_tracks

MANIFEST = "cues.json"
_FORMAT = 1
_POSES = "initial_world_T_cam"


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
            _POSES: _poses(sequence, video, folder),
            "report": report.to_dict(),
        },
    )


def has_manifest(folder: Path) -> bool:
    """Tell whether ``folder`` holds cues."""
    return (folder / MANIFEST).is_file()


def load_cues(video: Video, folder: Path) -> tuple[Sequence, CueReport]:
    """Open the cues that were made of a video.

    Args:
        video: As it was when they were made.
        folder: That of :func:`~uni4d_fg.cues.gather.gather_cues`.

    Raises:
        InputError: If they are not all there, or are those of another video.
    """
    path = folder / MANIFEST
    try:
        stored: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        fits = stored["num_frames"] == video.num_frames and tuple(stored["image_size"]) == video.image_size
        made = {name: stored[name] for name in ("depth", "masks", "tracks", "static", "intrinsics", "report", _POSES)}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); make the cues again with --resume") from error
    if not fits:
        raise InputError(
            f"{path}: cues of {stored['num_frames']} frames of {stored['image_size']} px, but {video.name} has "
            f"{video.num_frames} of {list(video.image_size)}; was the video replaced? Make the cues again"
        )
    changes: dict[str, Any] = {"intrinsics": np.array(made["intrinsics"], np.float64)}
    if made["depth"] is not None:
        changes["depths"] = FloatMaps(_paths(made["depth"], folder), video.image_size)
    if made["masks"] is not None:
        changes["masks"] = MaskFolder(_paths(made["masks"], folder), video.image_size)
    elif made["static"]:
        changes["masks"] = no_masks(video.image_size, video.num_frames)
    if made["tracks"] is not None:
        changes["tracks"] = load_tracks(folder / made["tracks"])
    if made[_POSES] is not None:
        changes[_POSES] = load_npy(folder / made[_POSES]).astype(np.float64)
    return as_sequence(replace(video, **changes)), CueReport.from_dict(made["report"])


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


def _paths(names: list[str], folder: Path) -> tuple[Path, ...]:
    paths = tuple(folder / name for name in names)
    missing = next((path for path in paths if not path.is_file()), None)
    if missing is not None:
        raise InputError(f"{missing}: a cue of this run is no longer there; make it again with --resume")
    return paths
