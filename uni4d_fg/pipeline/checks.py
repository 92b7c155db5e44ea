"""What a sequence in memory must satisfy before anything is computed from it; readers check files the same way."""

from __future__ import annotations

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.sequence.calibration import check_intrinsics, check_zoom
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of
from uni4d_fg.frontend.sequence.raw_tracks import normalization
from uni4d_fg.frontend.sequence.selection import MIN_FRAMES

_MAX_ROTATION_ERROR = 1e-6


def check_sequence(sequence: Sequence) -> None:
    """Check what can be checked without decoding a frame.

    Raises:
        InputError: With the first thing found wrong.
    """
    count, where = sequence.num_frames, f"sequence {sequence.name}"
    for name in ("intrinsics", "timestamps", "initial_world_T_cam"):
        array = getattr(sequence, name)
        if not (name == "initial_world_T_cam" and array is None) and not (
            isinstance(array, np.ndarray) and array.dtype.kind in "iuf"
        ):
            raise SequenceProblem(where, f"{name} is no array of numbers", "give a NumPy array of floats")
    if count < MIN_FRAMES:
        raise SequenceProblem(where, f"has {count} frame(s)", f"give at least {MIN_FRAMES}")
    for name, found in (("depth maps", len(sequence.depths)), ("masks", len(sequence.masks))):
        if found != count:
            raise SequenceProblem(where, f"has {found} {name}, but there are {count} images", "give one per image")
    intrinsics = sequence.intrinsics
    shown = intrinsics.tolist() if intrinsics.shape == (4,) else f"of shape {intrinsics.shape}"
    if intrinsics.shape != (4,) or not np.isfinite(intrinsics).all() or (intrinsics[:2] <= 0).any():
        raise SequenceProblem(
            where,
            f"intrinsics {shown} are not fx, fy, cx, cy with positive focal lengths",
            "give (4,) pixels",
        )
    if not sequence.is_self_calibrated:
        # What camera motion told is doubted where it is found, and no mistake of units.
        check_intrinsics(intrinsics, sequence.image_size, where)
    check_zoom(sequence.zoom, count, where)
    times = sequence.timestamps
    if times.shape != (count,) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise SequenceProblem(
            where, "timestamps are not one strictly increasing number of seconds per frame", "use the frame index"
        )
    tracks = sequence.tracks
    if tracks is not None:
        if tracks.num_frames != count:
            raise SequenceProblem(
                where, f"tracks cover {tracks.num_frames} frames of {count}", "track all frames, and no others"
            )
        if ((tracks.query_frame < 0) | (tracks.query_frame >= count)).any():
            raise SequenceProblem(where, "a track starts in no frame of the video", f"give 0 to {count - 1}")
        normalized = normalization(tracks.uv, tracks.visible, sequence.image_size)
        if normalized is not None:
            raise SequenceProblem(f"{where}: tracks", *normalized)
    if sequence.initial_world_T_cam is not None:
        _check_poses(where, sequence.initial_world_T_cam, count)


def _check_poses(where: str, poses: FloatArray, count: int) -> None:
    if poses.shape != (count, 4, 4):
        raise SequenceProblem(where, f"initial_world_T_cam has shape {poses.shape}", f"give ({count}, 4, 4) poses")
    finite = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    rotation = np.where(finite[:, None, None], poses[:, :3, :3], 0.0)
    error = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
    rigid = finite & (error <= _MAX_ROTATION_ERROR) & (np.linalg.det(rotation) > 0)
    rigid &= (poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    bad = np.flatnonzero(~rigid)
    if bad.size:
        raise SequenceProblem(
            where,
            f"initial_world_T_cam is not a rigid transform in frame(s) {some_of(bad.tolist())}",
            "give camera-to-world matrices of a right-handed rotation and a translation",
        )
