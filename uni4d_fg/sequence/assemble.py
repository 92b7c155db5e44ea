"""From files to a :class:`Sequence`, with the structural checks that are cheap."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray, Int32Array
from uni4d_fg.files import load_npz
from uni4d_fg.sequence.calibration import VaryingIntrinsics, guess_intrinsics, load_intrinsics
from uni4d_fg.sequence.frames import DepthFolder, ImageFolder, LazyFrames, MaskFolder, NpyDepth, no_masks
from uni4d_fg.sequence.layout import DEPTH_SUFFIXES, IMAGE_SUFFIXES, MASK_SUFFIXES, SequenceFiles, list_frames
from uni4d_fg.sequence.model import GroundTruth, Sequence
from uni4d_fg.sequence.poses import load_poses, load_timestamps
from uni4d_fg.sequence.problems import SequenceProblem
from uni4d_fg.sequence.track_files import RawTracks, load_native_tracks, load_uni4d_tracks
from uni4d_fg.sequence.video import VideoFrames

MIN_FRAMES = 2


def open_images(path: Path) -> ImageFolder | VideoFrames:
    """Open a folder of images or a video file; decodes the first frame. Raises InputError."""
    if path.is_file():
        return VideoFrames(path)
    return ImageFolder(list_frames(path, IMAGE_SUFFIXES))


def open_depth(path: Path, size: tuple[int, int] | None, units_per_metre: float = 1000.0) -> DepthFolder | NpyDepth:
    """Open a folder of depth maps or one ``.npy`` file of images of ``size``. Raises InputError."""
    if path.is_file():
        return NpyDepth(path, size)
    return DepthFolder(list_frames(path, DEPTH_SUFFIXES), size, units_per_metre)


def open_masks(path: Path, size: tuple[int, int] | None) -> MaskFolder:
    """Open a folder of label maps of images of ``size``. Raises InputError."""
    return MaskFolder(list_frames(path, MASK_SUFFIXES), size)


def check_count(path: Path, found: int, expected: int) -> None:
    """Raise InputError unless a cue has as many frames as there are images."""
    if found != expected:
        raise SequenceProblem(path, f"has {found} frames, but there are {expected} images", "give one per image")


def check_length(path: Path, num_frames: int) -> None:
    """Raise InputError if the video is too short to move in."""
    if num_frames < MIN_FRAMES:
        raise SequenceProblem(path, f"has {num_frames} frame(s)", f"give at least {MIN_FRAMES}")


def load_tracks(files: SequenceFiles, path: Path) -> RawTracks:
    """Read the tracks of either layout. Raises InputError."""
    return load_native_tracks(path) if files.layout == "native" else load_uni4d_tracks(path)


def load_ground_truth(
    path: Path, num_tracks: int | None, num_frames: int
) -> tuple[FloatArray | None, FloatArray | None]:
    """Read ``ground_truth.npz``.

    Args:
        path: The file.
        num_tracks: K of the sequence's own tracks, or None without tracks.
        num_frames: T.

    Returns:
        intrinsics (4,) and track_points (K, T, 3) in metres, each None when absent.

    Raises:
        InputError: If the file cannot be read or a shape does not match the sequence.
    """
    arrays = load_npz(path, {}, {"intrinsics": 1, "track_points": 3})
    intrinsics, points = arrays.get("intrinsics"), arrays.get("track_points")
    if intrinsics is not None:
        valid = intrinsics.shape == (4,) and bool(np.isfinite(intrinsics).all() and (intrinsics[:2] > 0).all())
        if not valid:
            raise SequenceProblem(
                path, "intrinsics are not fx, fy, cx, cy with positive focal lengths", "save them as (4,)"
            )
        intrinsics = intrinsics.astype(np.float64)
    if points is not None:
        if num_tracks is None or points.shape != (num_tracks, num_frames, 3):
            expected = "there are no tracks" if num_tracks is None else f"({num_tracks}, {num_frames}, 3) is expected"
            raise SequenceProblem(
                path,
                f"track_points has shape {points.shape}, but {expected}",
                "save one path per track, or none",
            )
        points = points.astype(np.float64)
    return intrinsics, points


def frame_names(images: ImageFolder | VideoFrames) -> tuple[str, ...]:
    """Return the stems of the image files, or five-digit frame numbers for a video."""
    if isinstance(images, VideoFrames):
        return tuple(f"{frame:05d}" for frame in range(len(images)))
    return tuple(path.stem for path in images.paths)


def default_timestamps(images: ImageFolder | VideoFrames) -> FloatArray:
    """Return (T,) seconds by the video's frame rate, or frame indices when that is unknown."""
    rate = images.frame_rate if isinstance(images, VideoFrames) else None
    return np.arange(len(images), dtype=np.float64) / (rate or 1.0)


def assemble(files: SequenceFiles) -> Sequence:
    """Read everything but the frames themselves; of these only the first is decoded.

    Raises:
        InputError: With the first thing found wrong.
    """
    for problem in files.problems:
        raise problem
    assert files.images is not None and files.depth is not None  # noqa: PT018 - else it is in problems
    images = open_images(files.images)
    num_frames, size = len(images), images.size
    check_length(files.images, num_frames)
    depths = open_depth(files.depth, size)
    check_count(files.depth, len(depths), num_frames)
    depths[0]
    masks: LazyFrames[Int32Array] = no_masks(size, num_frames)
    if files.masks is not None:
        masks = open_masks(files.masks, size)
        check_count(files.masks, len(masks), num_frames)
        masks[0]
    tracks = None
    if files.tracks is not None:
        tracks = load_tracks(files, files.tracks).to_tracks(num_frames, size)
    return Sequence(
        name=files.root.resolve().name,
        images=images,
        depths=depths,
        masks=masks,
        intrinsics=(
            guess_intrinsics(size) if files.intrinsics is None else load_intrinsics(files.intrinsics, num_frames, size)
        ),
        image_size=size,
        timestamps=(
            default_timestamps(images) if files.timestamps is None else load_timestamps(files.timestamps, num_frames)
        ),
        root=files.root,
        frame_names=frame_names(images),
        initial_world_T_cam=None if files.initial_poses is None else load_poses(files.initial_poses, num_frames),
        tracks=tracks,
        ground_truth=_assemble_truth(files, num_frames, size, None if tracks is None else tracks.num_tracks),
    )


def _assemble_truth(
    files: SequenceFiles, num_frames: int, size: tuple[int, int], num_tracks: int | None
) -> GroundTruth:
    depths = None
    if files.true_depth is not None:
        depths = open_depth(files.true_depth, size, files.true_depth_units_per_metre)
        check_count(files.true_depth, len(depths), num_frames)
        depths[0]
    intrinsics, points = None, None
    if files.ground_truth is not None:
        intrinsics, points = load_ground_truth(files.ground_truth, num_tracks, num_frames)
    elif files.true_intrinsics is not None:
        try:
            intrinsics = load_intrinsics(files.true_intrinsics, num_frames, size)
        except VaryingIntrinsics:
            # One camera cannot be compared with a zoom; the rest of the sequence is still of use.
            intrinsics = None
    return GroundTruth(
        world_T_cam=None if files.true_poses is None else load_poses(files.true_poses, num_frames),
        depths=depths,
        intrinsics=intrinsics,
        track_points=points,
    )
