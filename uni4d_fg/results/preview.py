"""What a run that is going on has found so far: cameras, static points, motion; sparse, from its newest stages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz
from uni4d_fg.frontend.sequence.model import Sequence, Video
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.results.io import reconstruction_problem
from uni4d_fg.results.labels_io import load_labels
from uni4d_fg.results.track_colors import track_colors
from uni4d_fg.slam.reconstruction import Reconstruction

_CAMERAS = {"world_T_cam": 3, "intrinsics": 1}
_SCENE = {**_CAMERAS, "log_scale": 1, "landmarks": 2, "landmark_track": 1, "landmark_error": 1}
_MOTION = {"points": 3, "observed": 2, "track": 1, "instance": 1}
_STAGES = (("camera_init", _CAMERAS), ("bundle_adjustment", _SCENE), ("nonrigid", _MOTION))


def check_has_cameras(root: Path) -> None:
    """Check that an unfinished run is far enough to be shown: before its sequence is opened, which may lack cues yet.

    Raises:
        InputError: If no stage has found cameras yet.
    """
    if not (root / "stages" / f"{_STAGES[0][0]}.npz").is_file():
        raise InputError(f"{root}: the run is not finished, and has no cameras to show yet; try again later")


def preview(root: Path, labels: Path, sequence: Sequence | Video) -> tuple[Reconstruction, str]:
    """Return what the stages of an unfinished run have found, and the name of the newest of them.

    Args:
        root: The run's folder.
        labels: Its labelled tracks.
        sequence: What it is made from.

    Raises:
        InputError: If no stage has found cameras yet, or not for every frame of the sequence.
    """
    check_has_cameras(root)
    found: dict[str, npt.NDArray[Any]] = {}
    newest, written = "", 0
    for name, ranks in _STAGES:
        path = root / "stages" / f"{name}.npz"
        # A stage that is older than the one before it is of an earlier run.
        if not path.is_file() or path.stat().st_mtime_ns < written:
            break
        found |= load_npz(path, ranks)
        newest, written = name, path.stat().st_mtime_ns
    if len(found["world_T_cam"]) != sequence.num_frames:
        raise InputError(
            f"{root}: the run is not finished, and a video with repeated frames has no preview; wait for its end"
        )
    labelled = load_labels(labels)
    _check_tracks(root, found, labelled, sequence.num_frames)
    result = _reconstruction(found, labelled, sequence)
    problem = reconstruction_problem(result)
    if problem:
        raise InputError(
            f"{root}: stage {newest} of the unfinished run is damaged ({problem}); continue it with --resume"
        )
    return result, newest


def _check_tracks(root: Path, found: dict[str, npt.NDArray[Any]], labelled: LabelledTracks, num_frames: int) -> None:
    """Raise InputError unless the stages' points are of the labelled tracks, and these of the sequence."""
    whole = labelled.tracks.num_frames == num_frames
    for name in ("landmark_track", "track", "instance"):
        numbers = found.get(name, np.zeros(0, np.int32))
        limit = labelled.tracks.num_tracks if name != "instance" else np.iinfo(np.int32).max
        inside = numbers.dtype.kind in "iu" and (not numbers.size or 0 <= numbers.min() <= numbers.max() < limit)
        whole = whole and bool(inside)
    if not whole:
        raise InputError(
            f"{root}: the unfinished run's stages do not fit its tracks (labels.npz); continue it with --resume"
        )


def _reconstruction(
    found: dict[str, npt.NDArray[Any]], labelled: LabelledTracks, sequence: Sequence | Video
) -> Reconstruction:
    num_frames = sequence.num_frames
    landmark_track = found.get("landmark_track", np.zeros(0)).astype(np.int32)
    dynamic_track = found.get("track", np.zeros(0)).astype(np.int32)
    colors = track_colors(sequence, labelled, np.concatenate([landmark_track, dynamic_track]))
    return Reconstruction(
        world_T_cam=found["world_T_cam"],
        intrinsics=found["intrinsics"],
        timestamps=sequence.timestamps,
        image_size=sequence.image_size,
        depth_log_scale=found.get("log_scale", np.zeros(num_frames)),
        landmarks=found.get("landmarks", np.zeros((0, 3))),
        landmark_track=landmark_track,
        landmark_color=colors[: len(landmark_track)],
        landmark_error=found.get("landmark_error", np.zeros(0)).astype(np.float32),
        dynamic_points=found.get("points", np.zeros((0, num_frames, 3))),
        dynamic_observed=found.get("observed", np.zeros((0, num_frames))).astype(bool),
        dynamic_track=dynamic_track,
        dynamic_instance=found.get("instance", np.zeros(0)).astype(np.int32),
        dynamic_color=colors[len(landmark_track) :],
    )
