"""From files to a :class:`Sequence`, with the structural checks that are cheap."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, Int32Array
from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npz
from uni4d_fg.frontend.sequence.calibration import (
    VaryingIntrinsics,
    check_zoom,
    guess_intrinsics,
    load_given_intrinsics,
    load_intrinsics,
)
from uni4d_fg.frontend.sequence.decode import check_bit_depth
from uni4d_fg.frontend.sequence.frames import DepthFolder, ImageFolder, LazyFrames, MaskFolder, NpyDepth, no_masks
from uni4d_fg.frontend.sequence.layout import DEPTH_SUFFIXES, IMAGE_SUFFIXES, MASK_SUFFIXES, SequenceFiles, list_frames
from uni4d_fg.frontend.sequence.model import GroundTruth, Sequence, Video
from uni4d_fg.frontend.sequence.poses import load_poses, load_timestamps
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.sequence.selection import MIN_FRAMES
from uni4d_fg.frontend.sequence.track_files import RawTracks, load_native_tracks, load_uni4d_tracks
from uni4d_fg.frontend.sequence.video import VideoFrames
from uni4d_fg.geometry.lens import PINHOLE, Lens
from uni4d_fg.reading import read_json


def open_images(path: Path, stop: int | None = None) -> ImageFolder | VideoFrames:
    """Open a folder of images or a video file; decodes the first frame. Raises InputError.

    Args:
        path: The folder or file.
        stop: Frames of a video file from this one on are not looked at.
    """
    if not path.is_dir():
        return VideoFrames(path, stop)
    paths = list_frames(path, IMAGE_SUFFIXES)
    images = ImageFolder(paths)
    check_bit_depth(*sampled(paths))
    return images


def sampled(paths: tuple[Path, ...]) -> list[Path]:
    """Return the first, the middle and the last file of a video."""
    return list(dict.fromkeys((paths[0], paths[len(paths) // 2], paths[-1])))


def open_depth(path: Path, size: tuple[int, int] | None, units_per_meter: float = 1000.0) -> DepthFolder | NpyDepth:
    """Open a folder of depth maps or one ``.npy`` file of images of ``size``. Raises InputError."""
    if not path.is_dir():
        return NpyDepth(path, size)
    return DepthFolder(list_frames(path, DEPTH_SUFFIXES), size, units_per_meter)


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


def load_tracks(files: SequenceFiles, path: Path, num_frames: int) -> RawTracks:
    """Read the tracks of either layout. Raises InputError."""
    return load_native_tracks(path, num_frames) if files.layout == "native" else load_uni4d_tracks(path, num_frames)


def load_ground_truth(path: Path, num_tracks: int | None, num_frames: int) -> GroundTruth:
    """Read ``ground_truth.npz``: what it holds of intrinsics, track points and the poses of rigid objects.

    Args:
        path: The file.
        num_tracks: K of the sequence's own tracks, or None without tracks.
        num_frames: T.

    Returns:
        The truth, without camera poses and depths, which have files of their own.

    Raises:
        InputError: If the file cannot be read or a shape does not match the sequence.
    """

    def check(shapes: dict[str, tuple[int, ...]]) -> None:
        points = shapes.get("track_points")
        if points is not None and (num_tracks is None or points != (num_tracks, num_frames, 3)):
            expected = "there are no tracks" if num_tracks is None else f"({num_tracks}, {num_frames}, 3) is expected"
            raise SequenceProblem(
                path, f"track_points has shape {points}, but {expected}", "save one path per track, or none"
            )

    ranks: dict[str, int | None] = {"intrinsics": 1, "track_points": 3, "rigid_instance": 1, "world_T_object": 4}
    arrays = load_npz(path, {}, ranks, check)
    intrinsics, points = arrays.get("intrinsics"), arrays.get("track_points")
    instance, poses = arrays.get("rigid_instance"), arrays.get("world_T_object")
    if intrinsics is not None:
        valid = intrinsics.shape == (4,) and bool(np.isfinite(intrinsics).all() and (intrinsics[:2] > 0).all())
        if not valid:
            raise SequenceProblem(
                path, "intrinsics are not fx, fy, cx, cy with positive focal lengths", "save them as (4,)"
            )
        intrinsics = intrinsics.astype(np.float64)
    if points is not None:
        points = points.astype(np.float64, copy=False)
    if instance is not None or poses is not None:
        if instance is None or poses is None or poses.shape != (len(instance), num_frames, 4, 4):
            raise SequenceProblem(
                path,
                f"rigid_instance and world_T_object do not fit each other and the {num_frames} frames",
                "save mask ids (J,) and poses (J, T, 4, 4)",
            )
        instance, poses = instance.astype(np.int32), poses.astype(np.float64)
    return GroundTruth(intrinsics=intrinsics, track_points=points, rigid_instance=instance, world_T_object=poses)


class DepthNote(NamedTuple):
    """What a file beside the depth cue says of it."""

    metric: bool = True
    """Whether depth is in meters."""
    parallax: bool | None = None
    """See :attr:`~uni4d_fg.frontend.sequence.model.Video.depth_parallax`."""
    focal_sigma: float | None = None
    """See :attr:`~uni4d_fg.frontend.sequence.model.Video.focal_sigma`."""
    lens: Lens = PINHOLE
    """Found with the intrinsics."""
    zoom: FloatArray | None = None
    """See :attr:`~uni4d_fg.frontend.sequence.model.Video.zoom`."""
    masks_from_motion: bool = False
    """See :attr:`~uni4d_fg.frontend.sequence.model.Video.masks_from_motion`."""


def load_depth_note(path: Path, num_frames: int) -> DepthNote:
    """Return what the file says.

    Raises:
        InputError: If it does not say whether depth is in meters, of which kind the motion was that it is from,
            how well that told the focal length, which camera was found with it, or whether masks are from motion.
    """
    note = read_json(path)
    if not isinstance(note, dict) or not isinstance(note.get("metric"), bool):
        raise SequenceProblem(
            path, "does not say whether depth is in meters", 'write {"metric": false} or {"metric": true}, or remove it'
        )
    motion = note.get("from_motion")
    if motion is not None and not (isinstance(motion, dict) and isinstance(motion.get("parallax"), bool)):
        raise SequenceProblem(
            path, "does not say whether the motion showed parallax",
            'write "from_motion": {"parallax": true} or {"parallax": false}, or leave it out',
        )  # fmt: skip
    sigma = note.get("focal_sigma")
    is_number = isinstance(sigma, int | float) and not isinstance(sigma, bool)
    if sigma is not None and not (is_number and 0.0 <= sigma < np.inf):
        raise SequenceProblem(
            path, f"has {sigma!r} for the standard deviation of the log focal length",
            'write "focal_sigma" as a number that is not negative, or leave it out',
        )  # fmt: skip
    masks_from_motion = note.get("masks_from_motion", False)
    if not isinstance(masks_from_motion, bool):
        raise SequenceProblem(
            path, f"has {masks_from_motion!r} for whether masks were found from motion",
            'write "masks_from_motion": true, or leave it out',
        )  # fmt: skip
    parallax = None if motion is None else motion["parallax"]
    lens, zoom = _noted_camera(note.get("camera"), path, num_frames)
    return DepthNote(note["metric"], parallax, None if sigma is None else float(sigma), lens, zoom, masks_from_motion)


def _noted_camera(note: Any, path: Path, num_frames: int) -> tuple[Lens, FloatArray | None]:
    """Return the lens and the zoom (T,) of a depth note."""
    if note is None:
        return PINHOLE, None
    try:
        lens = Lens(note["model"], tuple(float(value) for value in note["parameters"]))
        zoom = None if note.get("zoom") is None else np.array(note["zoom"], dtype=np.float64)
    except (KeyError, TypeError, ValueError, AttributeError, InputError) as error:
        raise SequenceProblem(
            path, f"does not say what the camera is ({error})",
            'write "camera": {"model": "RADIAL", "parameters": [k1, k2], "zoom": null}, or leave it out',
        ) from error  # fmt: skip
    check_zoom(zoom, num_frames, path)
    return lens, zoom


def frame_names(images: ImageFolder | VideoFrames) -> tuple[str, ...]:
    """Return the stems of the image files, or five-digit frame numbers for a video."""
    if isinstance(images, VideoFrames):
        return tuple(f"{frame:05d}" for frame in range(len(images)))
    return tuple(path.stem for path in images.paths)


def default_timestamps(images: ImageFolder | VideoFrames) -> FloatArray:
    """Return (T,) seconds as the video file has them, else by its frame rate, else frame indices."""
    if not isinstance(images, VideoFrames):
        return np.arange(len(images), dtype=np.float64)
    if images.times is not None:
        return images.times
    return np.arange(len(images), dtype=np.float64) / (images.frame_rate or 1.0)


def assemble(files: SequenceFiles) -> Sequence:
    """Read everything but the frames themselves; of these only the first is decoded.

    Masks that are absent call everything static; intrinsics that are absent are guessed.

    Raises:
        InputError: With the first thing found wrong, or if there is no depth.
    """
    for problem in files.problems:
        raise problem
    if files.no_depth is not None:
        raise files.no_depth
    return as_sequence(assemble_video(files))


def as_sequence(video: Video) -> Sequence:
    """Return a video with depth as a sequence; absent masks call everything static, absent intrinsics are guessed.

    Raises:
        InputError: If it has no depth.
    """
    if video.depths is None:
        raise SequenceProblem(video.root or video.name, "has no depth", "add a depth cue")
    size, num_frames = video.image_size, video.num_frames
    return Sequence(
        name=video.name,
        images=video.images,
        depths=video.depths,
        masks=no_masks(size, num_frames) if video.masks is None else video.masks,
        intrinsics=guess_intrinsics(size) if video.intrinsics is None else video.intrinsics,
        intrinsics_are_guessed=video.intrinsics is None,
        image_size=size,
        timestamps=video.timestamps,
        root=video.root,
        frame_names=video.frame_names,
        initial_world_T_cam=video.initial_world_T_cam,
        depth_is_metric=video.depth_is_metric,
        depth_parallax=video.depth_parallax,
        masks_from_motion=video.masks_from_motion,
        focal_sigma=video.focal_sigma,
        tracks=video.tracks,
        lens=video.lens,
        zoom=video.zoom,
        ground_truth=video.ground_truth,
        content=video.content,
    )


def as_video(sequence: Sequence) -> Video:
    """Return a sequence as a video that brings all its cues, and intrinsics unless they are guessed."""
    values = {field.name: getattr(sequence, field.name) for field in fields(Video)}
    return Video(**{**values, "intrinsics": sequence.given_intrinsics})


def assemble_video(files: SequenceFiles, stop: int | None = None) -> Video:
    """Read everything that is there but the frames themselves; of these only the first is decoded.

    Args:
        files: What to read.
        stop: Frames of a video file from this one on are not looked at; only if nothing else has one per frame.

    Raises:
        InputError: With the first thing found wrong.
    """
    for problem in files.problems:
        raise problem
    assert files.images is not None  # else it is in problems
    images = open_images(files.images, stop)
    num_frames, size = len(images), images.size
    check_length(files.images, num_frames)
    depths: LazyFrames[Float32Array] | None = None
    if files.depth is not None:
        depths = open_depth(files.depth, size)
        check_count(files.depth, len(depths), num_frames)
        depths[0]
    masks: LazyFrames[Int32Array] | None = None
    if files.masks is not None:
        masks = open_masks(files.masks, size)
        check_count(files.masks, len(masks), num_frames)
        masks[0]
    tracks = None
    if files.tracks is not None:
        tracks = load_tracks(files, files.tracks, num_frames).to_tracks(num_frames, size)
    root = files.root.resolve()
    note = DepthNote() if files.depth_note is None else load_depth_note(files.depth_note, num_frames)
    return Video(
        name=root.stem if root.is_file() else root.name,
        images=images,
        image_size=size,
        timestamps=(
            default_timestamps(images) if files.timestamps is None else load_timestamps(files.timestamps, num_frames)
        ),
        depths=depths,
        depth_is_metric=note.metric,
        depth_parallax=note.parallax,
        masks_from_motion=note.masks_from_motion,
        focal_sigma=note.focal_sigma,
        lens=note.lens,
        zoom=note.zoom,
        masks=masks,
        intrinsics=None if files.intrinsics is None else load_given_intrinsics(files.intrinsics, num_frames, size),
        tracks=tracks,
        root=files.root,
        frame_names=frame_names(images),
        initial_world_T_cam=None if files.initial_poses is None else load_poses(files.initial_poses, num_frames),
        ground_truth=_assemble_truth(files, num_frames, size, None if tracks is None else tracks.num_tracks),
    )


def _assemble_truth(
    files: SequenceFiles, num_frames: int, size: tuple[int, int], num_tracks: int | None
) -> GroundTruth:
    depths = None
    if files.true_depth is not None:
        depths = open_depth(files.true_depth, size, files.true_depth_units_per_meter)
        check_count(files.true_depth, len(depths), num_frames)
        depths[0]
    masks = None
    if files.true_masks is not None:
        masks = open_masks(files.true_masks, size)
        check_count(files.true_masks, len(masks), num_frames)
        masks[0]
    truth = GroundTruth()
    if files.ground_truth is not None:
        truth = load_ground_truth(files.ground_truth, num_tracks, num_frames)
    elif files.true_intrinsics is not None:
        try:
            truth = GroundTruth(intrinsics=load_intrinsics(files.true_intrinsics, num_frames, size))
        except VaryingIntrinsics:
            # One camera cannot be compared with a zoom; the rest of the sequence is still of use.
            truth = GroundTruth()
    poses = None if files.true_poses is None else load_poses(files.true_poses, num_frames, may_lack=True)
    return replace(truth, world_T_cam=poses, depths=depths, masks=masks)
