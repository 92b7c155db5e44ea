"""Writing a sequence, in the native layout or in Uni4D's; the folder appears whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import Float32Array, FloatArray, Int32Array
from uni4d_fg.errors import OutputError
from uni4d_fg.files import atomic_folder, save_npy, save_npz
from uni4d_fg.frontend.sequence.decode import clean_depth
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence
from uni4d_fg.frontend.sequence.native import DEFAULT_DEPTH, DEPTH_NOTE
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.geometry.camera import intrinsics_matrix

MAX_PNG_DEPTH = 65.0
"""Depth in meters from which on 16-bit millimeters do not reach."""
MAX_RGB_ID = 256**3 - 1


def write_native(sequence: Sequence, root: Path) -> None:
    """Write a sequence with all it holds in the native layout.

    Images become PNG. Depth becomes 16-bit PNG in millimeters (rounded, missing = 0), or one ``.npy`` file
    when it reaches 65 m. Files are named after the frames where that keeps their order, else by number.

    Args:
        sequence: What to write; frames are read one by one.
        root: The folder to make: absent or empty.

    Raises:
        OutputError: If ``root`` is in the way, the disk is full, or a mask id does not fit; nothing is left.
        InputError: If a frame of ``sequence`` cannot be read; nothing is left.
    """
    names = _file_names(sequence)
    truth = sequence.ground_truth
    with atomic_folder(root) as folder:
        _write_images(sequence, folder / "rgb", names)
        _write_cues(sequence, folder, names)
        times = "".join(f"{float(t)!r}\n" for t in sequence.timestamps)
        (folder / "timestamps.txt").write_text(times, encoding="utf-8")
        if sequence.initial_world_T_cam is not None:
            save_npy(folder / "world_T_cam_init.npy", sequence.initial_world_T_cam)
        if truth.world_T_cam is not None:
            save_npy(folder / "c2w.npy", truth.world_T_cam)
        if truth.depths is not None:
            _write_depth(truth.depths, folder / "depth_gt", names)
        if truth.masks is not None:
            _write_masks(truth.masks, folder / "masks_gt", names, always_rgb=False)
        more = {
            "intrinsics": truth.intrinsics,
            "track_points": truth.track_points,
            "rigid_instance": truth.rigid_instance,
            "world_T_object": truth.world_T_object,
        }
        known = {name: array for name, array in more.items() if array is not None}
        if known:
            save_npz(folder / "ground_truth.npz", **known)


def write_cues(sequence: Sequence, root: Path) -> None:
    """Write the cues of a sequence alone, as the native layout has them, for images that lie elsewhere.

    Args:
        sequence: Whose depth, masks, intrinsics and tracks to write.
        root: The folder to make: absent or empty.

    Raises:
        OutputError: As :func:`write_native`.
        InputError: If a frame of ``sequence`` cannot be read; nothing is left.
    """
    with atomic_folder(root) as folder:
        _write_cues(sequence, folder, _file_names(sequence))


def _write_cues(sequence: Sequence, folder: Path, names: tuple[str, ...]) -> None:
    _write_depth(sequence.depths, folder / DEFAULT_DEPTH, names)
    note: dict[str, Any] = {"metric": sequence.depth_is_metric}
    if sequence.depth_parallax is not None:
        note["from_motion"] = {"parallax": sequence.depth_parallax}
    if sequence.masks_from_motion:
        note["masks_from_motion"] = True
    if sequence.focal_sigma is not None:
        note["focal_sigma"] = sequence.focal_sigma
    if not sequence.lens.is_pinhole or sequence.zoom is not None:
        zoom = None if sequence.zoom is None else sequence.zoom.tolist()
        note["camera"] = {"model": sequence.lens.model, "parameters": sequence.lens.parameters, "zoom": zoom}
    if note != {"metric": True}:
        (folder / DEPTH_NOTE).write_text(json.dumps(note) + "\n", encoding="utf-8")
    _write_masks(sequence.masks, folder / "masks", names, always_rgb=False)
    save_npy(folder / "K.npy", intrinsics_matrix(sequence.intrinsics))
    if sequence.tracks is not None:
        _write_native_tracks(sequence.tracks, folder / "tracks.npz")


def write_uni4d(sequence: Sequence, root: Path) -> None:
    """Write a sequence in Uni4D's preprocessed layout, for its own program or others that read it.

    ``K.npy`` (T, 3, 3) holds the true intrinsics if they are known, else the sequence's, which also go to
    ``unidepth/intrinsics.npy``. Missing depth is 0. A track that is not visible keeps its nearest visible
    position, because that layout has no NaN. The layout has no place for timestamps, starting poses and
    true track points.

    Args:
        sequence: What to write; frames are read one by one.
        root: The folder to make: absent or empty.

    Raises:
        OutputError: If ``root`` is in the way, the disk is full, or a mask id does not fit; nothing is left.
        InputError: If a frame of ``sequence`` cannot be read; nothing is left.
    """
    names = _file_names(sequence)
    truth = sequence.ground_truth
    known = sequence.intrinsics if truth.intrinsics is None else truth.intrinsics
    with atomic_folder(root) as folder:
        _write_images(sequence, folder / "rgb", names)
        save_npy(folder / "K.npy", np.repeat(intrinsics_matrix(known)[None], sequence.num_frames, axis=0))
        if truth.world_T_cam is not None:
            save_npy(folder / "c2w.npy", truth.world_T_cam)
        height, width = sequence.image_size
        (folder / "unidepth").mkdir()
        _write_depth_array(
            sequence.depths, folder / "unidepth" / "depth.npy", (sequence.num_frames, 1, height, width), 0.0
        )
        save_npy(folder / "unidepth" / "intrinsics.npy", intrinsics_matrix(sequence.intrinsics))
        _write_masks(sequence.masks, folder / "deva" / "Annotations", names, always_rgb=True)
        if sequence.tracks is not None:
            _write_uni4d_tracks(sequence.tracks, sequence.image_size, folder / "cotrackerv3_10_50" / "results.npz")
        if truth.depths is not None:
            for name, depth in zip(names, truth.depths, strict=True):
                save_npy(folder / "depth_gt" / f"{name}.npy", clean_depth(depth))


def _file_names(sequence: Sequence) -> tuple[str, ...]:
    """Return the frames' own names if they are file names that sort in frame order, else their numbers."""
    names = sequence.frame_names
    plain = all(name.isprintable() and Path(name).name == name and name[:1] != "." for name in names)
    # Compared with the suffix on, which can change the order of names of which one begins another.
    written = [[f"{name}{suffix}" for name in names] for suffix in (".png", ".npy")]
    ordered = len(names) == sequence.num_frames and all(files == sorted(set(files)) for files in written)
    if plain and ordered:
        return names
    return tuple(f"{frame:05d}" for frame in range(sequence.num_frames))


def _write_png(path: Path, pixels: npt.NDArray[Any]) -> None:
    encoded, data = cv2.imencode(".png", pixels)
    if not encoded:
        raise OutputError(f"cannot write {path}: encoding a {pixels.shape} image failed; check its size")
    path.write_bytes(data.tobytes())


def _write_images(sequence: Sequence, folder: Path, names: Iterable[str]) -> None:
    folder.mkdir(parents=True)
    for name, image in zip(names, sequence.images, strict=True):
        _write_png(folder / f"{name}.png", np.ascontiguousarray(image[:, :, ::-1]))


def _write_masks(masks: FrameSource[Int32Array], folder: Path, names: Iterable[str], always_rgb: bool) -> None:
    folder.mkdir(parents=True)
    for name, mask in zip(names, masks, strict=True):
        low, high = int(mask.min()), int(mask.max())
        if low < 0 or high > MAX_RGB_ID:
            raise OutputError(
                f"cannot write mask of frame {name}: its ids reach from {low} to {high}; use ids from 0 to {MAX_RGB_ID}"
            )
        if high <= 255 and not always_rgb:
            _write_png(folder / f"{name}.png", mask.astype(np.uint8))
        else:
            blue_green_red = [(mask >> shift) & 255 for shift in (16, 8, 0)]
            _write_png(folder / f"{name}.png", np.stack(blue_green_red, axis=-1).astype(np.uint8))


def _farthest(depths: FrameSource[Float32Array]) -> float:
    """Return the largest depth of a video, meters; 0 if all is missing."""
    return max((float(np.nanmax(d, initial=0.0)) for d in map(clean_depth, depths)), default=0.0)


def _write_depth(depths: FrameSource[Float32Array], folder: Path, names: tuple[str, ...]) -> None:
    """Write 16-bit PNGs into ``folder``, or an array beside it when depth reaches too far."""
    if _farthest(depths) >= MAX_PNG_DEPTH:
        shape = (len(depths), *depths[0].shape)
        _write_depth_array(depths, folder.with_name(f"{folder.name}.npy"), shape, np.nan)
        return
    folder.mkdir(parents=True)
    for name, depth in zip(names, depths, strict=True):
        millimeters = np.rint(np.nan_to_num(clean_depth(depth), nan=0.0) * np.float32(1000.0))
        _write_png(folder / f"{name}.png", millimeters.astype(np.uint16))


def _write_depth_array(depths: FrameSource[Float32Array], path: Path, shape: tuple[int, ...], missing: float) -> None:
    """Write frame after frame behind a .npy header; through a memory map a full disk would kill the process."""
    with open(path, "wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
        for depth in depths:
            stream.write(np.nan_to_num(clean_depth(depth), nan=missing).astype("<f4").tobytes())


def _write_native_tracks(tracks: Tracks, path: Path) -> None:
    arrays: dict[str, npt.NDArray[Any]] = {
        "uv": tracks.uv,
        "visible": tracks.visible,
        "query_frame": tracks.query_frame,
    }
    if tracks.confidence is not None:
        arrays["confidence"] = tracks.confidence
    save_npz(path, **arrays)


def _hold_position(tracks: Tracks) -> FloatArray:
    """Return (K, T, 2) positions in which a hidden observation repeats the last (or else the next) visible one."""
    num_tracks, num_frames = tracks.visible.shape
    frame = np.broadcast_to(np.arange(num_frames), (num_tracks, num_frames))
    last = np.maximum.accumulate(np.where(tracks.visible, frame, -1), axis=1)
    following = np.where(tracks.visible, frame, num_frames)[:, ::-1]
    following = np.minimum.accumulate(following, axis=1)[:, ::-1]
    source = np.where(last >= 0, last, following)
    held = np.take_along_axis(tracks.uv, np.minimum(source, num_frames - 1)[..., None], axis=1).astype(np.float64)
    held[source == num_frames] = 0.0
    return held


def _write_uni4d_tracks(tracks: Tracks, size: tuple[int, int], path: Path) -> None:
    confidence = tracks.visible if tracks.confidence is None else tracks.confidence
    save_npz(
        path,
        all_tracks=_hold_position(tracks).swapaxes(0, 1),
        all_visibilities=tracks.visible.T.astype(np.float64),
        all_confidences=confidence.T.astype(np.float64),
        init_frames=tracks.query_frame.astype(np.int64),
        orig_shape=np.array(size, dtype=np.int64),
    )
