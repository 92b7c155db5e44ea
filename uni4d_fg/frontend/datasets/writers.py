"""Writing a sequence with truth as if it were a video of one of the datasets, file by file in its layout.

Numbers of text files have more digits than the real ones, so that the truth comes back as it was. Frames that the
dataset's convention leaves out are written too.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, ImageArray
from uni4d_fg.errors import InputError, OutputError
from uni4d_fg.files import atomic_path
from uni4d_fg.frontend.datasets import bonn, kitti, tum
from uni4d_fg.frontend.datasets.sintel_files import write_cam, write_dpt
from uni4d_fg.frontend.datasets.tum_files import CALIBRATION
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.trajectory_files import continuous_quaternions
from uni4d_fg.geometry.camera import intrinsics_matrix

_CLOCK_S = 1311868163.0
"""Added to times that start at 0: names of files are seconds of the epoch."""


def write_sintel(sequence: Sequence, root: Path, video: str) -> None:
    """Write one video of Sintel: images as 'final' and 'clean', ``.dpt``, ``.cam``, and masks as MonST3R derives them.

    Raises:
        InputError: If the sequence has no true depth or poses.
        OutputError: If a file cannot be written.
    """
    depths, poses, intrinsics = _truth(sequence)
    matrix, base, masks = intrinsics_matrix(intrinsics), root / "training", sequence.ground_truth.masks
    for frame, image in enumerate(sequence.images):
        name = f"frame_{frame + 1:04d}"
        for render in ("final", "clean"):
            _png(base / render / video / f"{name}.png", _bgr(image))
        write_dpt(base / "depth" / video / f"{name}.dpt", np.nan_to_num(depths[frame], nan=0.0))
        write_cam(base / "camdata_left" / video / f"{name}.cam", matrix, poses[frame])
        if masks is not None:
            _png(base / "dynamic_label_perfect" / video / f"{name}.png", np.uint8(255) * (masks[frame] > 0))


def write_tum(sequence: Sequence, root: Path, video: str) -> None:
    """Write one video of the TUM RGB-D benchmark.

    Raises:
        InputError: If the sequence has no true depth or poses.
        OutputError: If a file cannot be written, or depth reaches beyond 13 m.
    """
    _write_rgbd(sequence, root / f"{tum.PREFIX}{video}", tum.UNITS_PER_METER)


def write_bonn(sequence: Sequence, root: Path, video: str) -> None:
    """Write one video of Bonn's dataset. Raises as :func:`write_tum`."""
    _write_rgbd(sequence, root / f"{bonn.PREFIX}{video}", bonn.UNITS_PER_METER)


def write_kitti(sequence: Sequence, root: Path, video: str) -> None:
    """Write one drive of KITTI's depth benchmark with its images.

    Depth is dense: the sequence's.

    Raises:
        InputError: If the sequence has no true depth, or ``video`` does not begin with a date, ``2011_09_26_``.
        OutputError: If a file cannot be written, or depth reaches beyond 255 m.
    """
    depths, _, intrinsics = _truth(sequence)
    date = video[:10]
    if len(video) < 12 or [len(part) for part in date.split("_")] != [4, 2, 2]:
        raise InputError(f"{video}: drives of KITTI are named like {kitti.VIDEOS[0]}; choose such a name")
    raw = root / date / video / "image_02"
    stamps = []
    for frame, image in enumerate(sequence.images):
        _png(raw / "data" / f"{frame:010d}.png", _bgr(image))
        depth = root / "val" / video / "proj_depth" / "groundtruth" / "image_02" / f"{frame:010d}.png"
        _png(depth, _depth_units(depths[frame], kitti.UNITS_PER_METER))
        time = float(sequence.timestamps[frame] - sequence.timestamps[0])
        stamps.append(f"2011-09-26 13:02:{int(time):02d}.{round((time % 1.0) * 1e9):09d}\n")
    if sequence.timestamps[-1] - sequence.timestamps[0] < 57.0:
        _text(raw / "timestamps.txt", "".join(stamps))
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    projection = " ".join(f"{v:.12e}" for v in (fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0))
    _text(root / date / "calib_cam_to_cam.txt", f"calib_time: 09-Jan-2012 13:57:47\nP_rect_02: {projection}\n")


def _write_rgbd(sequence: Sequence, folder: Path, units_per_meter: float) -> None:
    depths, poses, intrinsics = _truth(sequence)
    times = sequence.timestamps - sequence.timestamps[0] + _CLOCK_S
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for frame, image in enumerate(sequence.images):
        name = f"{times[frame]:.6f}"
        for kind, pixels in (("rgb", _bgr(image)), ("depth", _depth_units(depths[frame], units_per_meter))):
            _png(folder / kind / f"{name}.png", pixels)
            lists[kind].append(f"{name} {kind}/{name}.png\n")
    for kind, title in (("rgb", "color images"), ("depth", "depth maps")):
        _text(folder / f"{kind}.txt", f"# {title}\n# file: synthetic\n# timestamp filename\n{''.join(lists[kind])}")
    _text(folder / CALIBRATION, " ".join(f"{float(v)!r}" for v in intrinsics) + "\n")
    quaternions = continuous_quaternions(poses[:, :3, :3])
    rows = [
        f"{time:.6f} {' '.join(f'{v:.9f}' for v in (*pose[:3, 3], *quaternion))}\n"
        for time, pose, quaternion in zip(times, poses, quaternions, strict=True)
    ]
    _text(
        folder / "groundtruth.txt",
        f"# ground truth trajectory\n# file: synthetic\n# timestamp tx ty tz qx qy qz qw\n{''.join(rows)}",
    )


WRITERS: dict[str, Callable[[Sequence, Path, str], None]] = {
    "sintel": write_sintel, "tum": write_tum, "bonn": write_bonn, "kitti": write_kitti
}  # fmt: skip
"""By the name of ``uni4d-fg synthesize --as``."""


def _truth(sequence: Sequence) -> tuple[list[Float32Array], FloatArray, FloatArray]:
    truth = sequence.ground_truth
    if truth.depths is None or truth.world_T_cam is None or truth.intrinsics is None:
        raise InputError(f"{sequence.name}: has no true depth, poses and intrinsics to write; give a synthetic scene")
    return list(truth.depths), truth.world_T_cam, truth.intrinsics


def _depth_units(depth: Float32Array, units_per_meter: float) -> np.ndarray:
    farthest = float(np.nanmax(depth, initial=0.0))
    if farthest * units_per_meter > 65534:
        raise OutputError(
            f"depth of {farthest:.1f} m does not fit into 16 bits of {units_per_meter:g} per meter; "
            "write another layout"
        )
    return np.rint(np.nan_to_num(depth, nan=0.0).astype(np.float64) * units_per_meter).astype(np.uint16)


def _bgr(image: ImageArray) -> ImageArray:
    return np.ascontiguousarray(image[:, :, ::-1])


def _png(path: Path, pixels: np.ndarray) -> None:
    encoded, data = cv2.imencode(".png", pixels.astype(pixels.dtype))
    if not encoded:
        raise OutputError(f"cannot write {path}: encoding a {pixels.shape} image failed; check its size")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())


def _text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
