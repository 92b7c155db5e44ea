"""Pieces of other programs' outputs: depth maps in many forms, poses of some frames, trajectories."""

from __future__ import annotations

import re
import struct
import zipfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.files import DAMAGED_ARCHIVE, load_npy, load_npz
from uni4d_fg.frontend.sequence.decode import MAX_PIXELS, clean_depth, read_depth
from uni4d_fg.frontend.sequence.frames import LazyFrames
from uni4d_fg.frontend.sequence.layout import is_visible_file
from uni4d_fg.pipeline.benchmark.methods.exr import read_exr
from uni4d_fg.reading import MAX_IMAGE_BYTES, list_folder, read_bytes, read_text

DEPTH_SUFFIXES = (".npy", ".npz", ".exr", ".png", ".raw")
_RAW_HEADER = struct.Struct("<iiiQ")
_CV_32F = 5
_FRAME = re.compile("[0-9]{1,9}")


class MethodDepth(LazyFrames[Float32Array]):
    """Depth of every frame in a file of its own.

    Args:
        paths: T files: ``.npy``, ``.npz`` (``depth``, or ``disp`` to be inverted), EXR, 16-bit PNG, Robust-CVD's
            ``.raw``.
        disparity: The values are 1 / depth.
        units_per_meter: Of PNGs.
    """

    def __init__(self, paths: tuple[Path, ...], *, disparity: bool = False, units_per_meter: float = 1000.0) -> None:
        self.paths, self.disparity, self.units_per_meter = paths, disparity, units_per_meter

    def __len__(self) -> int:
        return len(self.paths)

    def where(self, frame: int) -> str:
        """Return the file of a frame."""
        return str(self.paths[frame])

    def _read(self, frame: int) -> Float32Array:
        return read_any_depth(self.paths[frame], self.disparity, self.units_per_meter)


class ZippedDepth(LazyFrames[Float32Array]):
    """Depth of every frame in a zip of EXR files that are named by frame, as ViPE writes it."""

    def __init__(self, path: Path, num_frames: int) -> None:
        self.path, self.num_frames = path, num_frames
        try:
            with zipfile.ZipFile(path) as archive:
                members = {Path(n).stem: n for n in archive.namelist() if n.endswith(".exr")}
        except DAMAGED_ARCHIVE as error:
            raise InputError(f"{path}: cannot be read as a zip of EXR files ({error}); write it again") from error
        self.members = {int(stem): name for stem, name in members.items() if _FRAME.fullmatch(stem)}
        absent = sorted(set(range(num_frames)) - set(self.members))
        if absent:
            raise InputError(f"{path}: lacks depth of frame {absent[0]}; run the program on all frames")

    def __len__(self) -> int:
        return self.num_frames

    def where(self, frame: int) -> str:
        """Return the file in the archive."""
        return f"{self.path}: {self.members[frame]}"

    def _read(self, frame: int) -> Float32Array:
        try:
            with zipfile.ZipFile(self.path) as archive:
                info = archive.getinfo(self.members[frame])
                if info.file_size > MAX_IMAGE_BYTES:
                    raise InputError(f"{self.where(frame)}: would take {info.file_size} bytes; check the file")
                data = archive.read(info)
        except DAMAGED_ARCHIVE as error:
            raise InputError(f"{self.where(frame)}: cannot be unpacked ({error}); write it again") from error
        return read_exr(data, self.where(frame))


def depth_files(folder: Path, pattern: str, count: int) -> tuple[Path, ...]:
    """Return the files of a folder that fit a pattern, by name. Raises InputError unless there is one per frame."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; check the output of the method")
    paths = tuple(
        p for p in list_folder(folder) if is_visible_file(p) and p.match(pattern) and p.suffix in DEPTH_SUFFIXES
    )
    if len(paths) != count:
        raise InputError(
            f"{folder}: has {len(paths)} files {pattern} for {count} frames; run the method on all of them"
        )
    return paths


def read_any_depth(path: Path, disparity: bool = False, units_per_meter: float = 1000.0) -> Float32Array:
    """Read one depth map (H, W). Raises InputError."""
    suffix = path.suffix.lower()
    if suffix == ".npy":
        values = load_npy(path)
    elif suffix == ".npz":
        arrays = load_npz(path, {}, {"depth": None, "disp": None, "disparity": None})
        if not arrays:
            raise InputError(f"{path}: has neither depth nor disp; check what the method wrote")
        disparity = disparity or "depth" not in arrays
        values = arrays["depth"] if "depth" in arrays else next(iter(arrays.values()))
    elif suffix == ".exr":
        values = read_exr(read_bytes(path, MAX_IMAGE_BYTES, "an EXR file"), str(path))
    elif suffix == ".raw":
        values = _raw(path)
    else:
        values = read_depth(path, units_per_meter)
    values = np.squeeze(values)
    if values.ndim != 2 or values.dtype.kind != "f":
        raise InputError(f"{path}: has shape {values.shape} of {values.dtype}; depth maps are (H, W) floats")
    if disparity:
        with np.errstate(divide="ignore"):
            values = 1.0 / values
    return clean_depth(values)


def _raw(path: Path) -> Float32Array:
    """Read the format of ``image_io.py`` of Robust-CVD: height, width, OpenCV type, bytes per pixel, rows of floats."""
    data = read_bytes(path, MAX_IMAGE_BYTES, "a .raw file")
    if len(data) < _RAW_HEADER.size:
        raise InputError(f"{path}: is cut short; write it again")
    height, width, kind, size = _RAW_HEADER.unpack_from(data)
    whole = 0 < height * width <= MAX_PIXELS and len(data) == _RAW_HEADER.size + 4 * height * width
    if not whole or kind != _CV_32F or size != 4:
        raise InputError(f"{path}: is not one channel of float32 of {width} x {height} px; write it again")
    return np.frombuffer(data, "<f4", offset=_RAW_HEADER.size).reshape(height, width)


def read_numbers(path: Path, columns: tuple[int, ...]) -> FloatArray:
    """Read rows of numbers; ``#`` begins a comment. Raises InputError unless all have as many as one of ``columns``."""
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.replace(",", " ").split("#")[0].split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}; expected numbers") from error
        if len(words) not in columns or len(words) != len(rows[0]):
            raise InputError(f"{path}, line {number}: {len(words)} columns, expected {' or '.join(map(str, columns))}")
    if not rows:
        raise InputError(f"{path}: holds no numbers; check the output of the method")
    values = np.array(rows)
    if not np.isfinite(values).all():
        raise InputError(f"{path}: has a number that is NaN or infinite; check the output of the method")
    return values


def poses_of_rows(path: Path, rows: FloatArray, times: FloatArray, *, scalar_first: bool) -> FloatArray:
    """Return the poses (T, 4, 4) of the frames from rows of time, position and quaternion.

    Args:
        path: For messages.
        rows: (N, 8). As many as frames: one each, whatever their times. Else those whose time is within half the
            shortest distance of a frame's, or whose number is the frame's; the other frames have NaN.
        times: (T,) s of the frames.
        scalar_first: The quaternion is w x y z.

    Raises:
        InputError: If no row belongs to a frame, or a quaternion is not of unit length.
    """
    quaternions = rows[:, [5, 6, 7, 4]] if scalar_first else rows[:, 4:8]
    if (np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) > 1e-2).any():
        raise InputError(f"{path}: a quaternion is not of unit length; check the layout")
    world_T_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    world_T_cam[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    world_T_cam[:, :3, 3] = rows[:, 1:4]
    if len(rows) == len(times):
        return world_T_cam
    poses: FloatArray = np.full((len(times), 4, 4), np.nan)
    numbers = np.rint(rows[:, 0]).astype(np.int64)
    if np.abs(rows[:, 0] - numbers).max() < 1e-6 and numbers.min() >= 0 and numbers.max() < len(times):
        poses[numbers] = world_T_cam
        return poses
    tolerance = 0.5 * float(np.diff(times).min())
    for row, pose in zip(rows, world_T_cam, strict=True):
        frame = int(np.abs(times - row[0]).argmin())
        if abs(times[frame] - row[0]) <= tolerance:
            poses[frame] = pose
    if np.isnan(poses).all():
        raise InputError(
            f"{path}: has {len(rows)} poses for {len(times)} frames, and neither their times nor their numbers fit"
        )
    return poses
