"""Where other programs put cameras and depth; each layout names the program's file that writes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray
from uni4d_fg.errors import InputError
from uni4d_fg.files import load_npy, load_npz
from uni4d_fg.frontend.sequence.frames import NpyDepth
from uni4d_fg.frontend.sequence.model import ArrayFrames, FrameSource, Video
from uni4d_fg.frontend.trajectory_files import read_kitti
from uni4d_fg.geometry.se3 import inverse
from uni4d_fg.pipeline.benchmark.methods.files import (
    DEPTH_SUFFIXES,
    MethodDepth,
    ZippedDepth,
    depth_files,
    poses_of_rows,
    read_numbers,
)
from uni4d_fg.pipeline.benchmark.score import Estimate
from uni4d_fg.reading import list_folder, read_text

Read = Callable[[Path, str, Video], Estimate]


@dataclass(frozen=True)
class Layout:
    """How one program leaves its results."""

    files: str
    """Where, with the program's file that writes them."""
    read: Read


def _files(folder: Path, video: str, opened: Video) -> Estimate:
    """Plain files: a TUM or KITTI trajectory, a folder or array of depth."""
    base = folder / video
    trajectory = _first(base / "trajectory.tum", base / "traj.txt", folder / f"{video}.txt", folder / f"{video}.tum")
    kitti = _first(base / "poses.txt", base / "trajectory.kitti")
    poses = None
    if trajectory is not None:
        poses = poses_of_rows(trajectory, read_numbers(trajectory, (8,)), opened.timestamps, scalar_first=False)
    elif kitti is not None:
        poses = _counted(kitti, read_kitti(kitti).world_T_cam, opened)
    elif (base / "c2w.npy").is_file():
        poses = _counted(base / "c2w.npy", load_npy(base / "c2w.npy").astype(np.float64), opened)
    depths: FrameSource[Float32Array] | None = None
    if (base / "depth.npy").is_file():
        depths = NpyDepth(base / "depth.npy")
        _check(base / "depth.npy", len(depths), opened)
    elif (base / "depth").is_dir():
        depths = MethodDepth(_depths(base / "depth", opened))
    return _something(base, Estimate(poses, depths, _matrix(base / "K.npy")))


def _trajectory(folder: Path, video: str, opened: Video) -> Estimate:
    """A TUM trajectory alone: ``VIDEO.txt``, or one in ``VIDEO/``; frames without a row have no pose."""
    inside = (
        [p for p in list_folder(folder / video) if p.suffix in (".txt", ".tum")] if (folder / video).is_dir() else []
    )
    path = _first(folder / f"{video}.txt", folder / f"{video}.tum", *inside)
    if path is None:
        raise InputError(f"{folder}: has neither {video}.txt nor a trajectory in {video}/; check the folder")
    return Estimate(poses_of_rows(path, read_numbers(path, (8,)), opened.timestamps, scalar_first=False))


def _monst3r(folder: Path, video: str, opened: Video) -> Estimate:
    base, count = folder / video, opened.num_frames
    poses, intrinsics = None, None
    if (base / "pred_traj.txt").is_file():
        path = base / "pred_traj.txt"
        poses = poses_of_rows(path, read_numbers(path, (8,)), opened.timestamps, scalar_first=True)
    depths = MethodDepth(depth_files(base, "frame_*.npy", count)) if list(base.glob("frame_*.npy")) else None
    if (base / "pred_intrinsics.txt").is_file():
        rows = read_numbers(base / "pred_intrinsics.txt", (3, 9)).reshape(-1, 9)
        intrinsics = rows[:, (0, 4, 2, 5)].mean(axis=0)
    return _something(base, Estimate(poses, depths, intrinsics))


def _megasam(folder: Path, video: str, opened: Video) -> Estimate:
    path = _first(folder / f"{video}_sgd_cvd_hr.npz", folder / f"{video}_droid.npz")
    if path is None:
        raise InputError(f"{folder}: has neither {video}_sgd_cvd_hr.npz nor {video}_droid.npz; check the folder")
    arrays = load_npz(path, {"depths": 3, "cam_c2w": 3}, {"intrinsic": None})
    _check(path, len(arrays["depths"]), opened)
    matrix = arrays.get("intrinsic")
    known = None if matrix is None else np.asarray(matrix, np.float64).reshape(-1, 9)[0][[0, 4, 2, 5]]
    poses = _counted(path, arrays["cam_c2w"].astype(np.float64), opened)
    return Estimate(poses, ArrayFrames(arrays["depths"].astype(np.float32)), known)


def _vipe(folder: Path, video: str, opened: Video) -> Estimate:
    path, depth, camera = (
        folder / name for name in (f"pose/{video}.npz", f"depth/{video}.zip", f"intrinsics/{video}.npz")
    )
    poses, intrinsics = None, None
    if path.is_file():
        arrays = load_npz(path, {"data": 3, "inds": 1}, {})
        poses = np.full((opened.num_frames, 4, 4), np.nan)
        inside = (arrays["inds"] >= 0) & (arrays["inds"] < opened.num_frames)
        poses[arrays["inds"][inside].astype(np.int64)] = arrays["data"][inside]
    if camera.is_file():
        intrinsics = load_npz(camera, {"data": 2}, {"inds": None})["data"].astype(np.float64)[:, :4].mean(axis=0)
    depths = ZippedDepth(depth, opened.num_frames) if depth.is_file() else None
    return _something(folder, Estimate(poses, depths, intrinsics))


def _uni4d(folder: Path, video: str, opened: Video) -> Estimate:
    """``R`` and ``t`` are camera to world; depth is 1 / ``disp``."""
    inner = [base for base in (folder / video, *sorted(folder.glob(f"{video}/**/"))) if list(base.glob("0*.npz"))]
    if not inner:
        raise InputError(f"{folder / video}: has no 0000.npz, 0001.npz, ...; check the folder")
    paths = depth_files(inner[0], "[0-9]*.npz", opened.num_frames)
    poses = np.tile(np.eye(4), (len(paths), 1, 1))
    intrinsics = None
    for frame, path in enumerate(paths):
        arrays = load_npz(path, {"R": None, "t": None}, {"K": None})
        poses[frame, :3, :3] = arrays["R"].reshape(3, 3)
        poses[frame, :3, 3] = arrays["t"].reshape(3)
        if frame == 0 and "K" in arrays and arrays["K"].size == 9:
            intrinsics = arrays["K"].astype(np.float64).reshape(9)[[0, 4, 2, 5]]
    return Estimate(poses, MethodDepth(paths, disparity=True), intrinsics)


def _robust_cvd(folder: Path, video: str, opened: Video) -> Estimate:
    """Extrinsics have columns right, up, backward and position; depth files hold 1 / depth."""
    base = folder / video
    poses, depths = None, None
    if (base / "metadata.npz").is_file():
        stored = load_npz(base / "metadata.npz", {"extrinsics": 3}, {"intrinsics": None})["extrinsics"]
        poses = np.tile(np.eye(4), (len(stored), 1, 1))
        poses[:, :3] = stored[:, :3, :4] * np.array([1.0, -1.0, -1.0, 1.0])
        poses = _counted(base / "metadata.npz", poses, opened)
    found = sorted({path.parent for path in base.glob("**/depth/frame_*.raw")})
    if found:
        depths = MethodDepth(depth_files(found[-1], "frame_*.raw", opened.num_frames), disparity=True)
    return _something(base, Estimate(poses, depths))


def _colmap(folder: Path, video: str, opened: Video) -> Estimate:
    """World to camera, scalar first; images are matched to frames by their names."""
    path = _first(folder / video / "images.txt", folder / video / "sparse" / "0" / "images.txt")
    if path is None:
        raise InputError(f"{folder / video}: has no images.txt; export the model as text (colmap model_converter)")
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    number = {name: frame for frame, name in enumerate(opened.frame_names)}
    poses: FloatArray = np.full((opened.num_frames, 4, 4), np.nan)
    for line in lines:
        words = line.split()
        if len(words) < 10 or Path(words[9]).stem not in number:
            continue  # a line of points, or an image that is not of these frames
        try:
            values = np.array([float(word) for word in words[1:8]])
        except ValueError as error:
            raise InputError(f"{path}: {line[:60]!r} is not a pose; export the model again") from error
        row = np.concatenate(([0.0], values[4:], values[:4]))[None]
        poses[number[Path(words[9]).stem]] = inverse(poses_of_rows(path, row, np.zeros(1), scalar_first=True)[0])
    if np.isnan(poses).all():
        raise InputError(f"{path}: no image has the name of a frame ({opened.frame_names[0]}, ...); check the folder")
    return Estimate(poses)


def _first(*paths: Path) -> Path | None:
    return next((path for path in paths if path.is_file()), None)


def _check(path: Path, count: int, opened: Video) -> None:
    if count != opened.num_frames:
        raise InputError(
            f"{path}: has {count} frames, the video {opened.num_frames}; run the method on the same frames"
        )


def _counted(path: Path, poses: FloatArray, opened: Video) -> FloatArray:
    _check(path, len(poses), opened)
    if poses.shape[1:] != (4, 4):
        raise InputError(f"{path}: poses have shape {poses.shape}, expected (T, 4, 4)")
    return poses


def _depths(folder: Path, opened: Video) -> tuple[Path, ...]:
    suffixes = {path.suffix for path in list_folder(folder)} & set(DEPTH_SUFFIXES)
    if len(suffixes) != 1:
        raise InputError(f"{folder}: holds files of {len(suffixes)} kinds of depth; leave one kind there")
    return depth_files(folder, f"*{suffixes.pop()}", opened.num_frames)


def _matrix(path: Path) -> FloatArray | None:
    return load_npy(path).astype(np.float64).reshape(-1, 9)[0][[0, 4, 2, 5]] if path.is_file() else None


def _something(where: Path, estimate: Estimate) -> Estimate:
    if estimate.world_T_cam is None and estimate.depths is None:
        raise InputError(f"{where}: holds neither cameras nor depth in this layout; check the folder")
    return estimate


LAYOUTS: dict[str, Layout] = {
    "files": Layout(
        "VIDEO/trajectory.tum, poses.txt (KITTI) or c2w.npy; depth.npy, or depth/ of .npy, .npz, .exr or .png (mm)",
        _files,
    ),
    "monst3r": Layout("VIDEO/pred_traj.txt, frame_0000.npy, pred_intrinsics.txt (base_opt.py)", _monst3r),
    "cut3r": Layout("VIDEO/pred_traj.txt, frame_0000.npy, pred_intrinsics.txt (eval/*/utils.py)", _monst3r),
    "megasam": Layout("VIDEO_sgd_cvd_hr.npz (cvd_opt.py), else VIDEO_droid.npz", _megasam),
    "vipe": Layout("pose/VIDEO.npz, depth/VIDEO.zip of EXR, intrinsics/VIDEO.npz (vipe/utils/io.py)", _vipe),
    "uni4d": Layout("VIDEO/uni4d/EXPERIMENT/0000.npz (engine.py)", _uni4d),
    "casualsam": Layout("VIDEO/.../0000.npz (slam/slamopt.py)", _uni4d),
    "robust-cvd": Layout("VIDEO/metadata.npz, VIDEO/.../depth/frame_000000.raw (utils/image_io.py)", _robust_cvd),
    "dpvo": Layout("VIDEO.txt, TUM", _trajectory),
    "leapvo": Layout("VIDEO.txt or VIDEO/*.txt, TUM", _trajectory),
    "colmap": Layout("VIDEO/images.txt or VIDEO/sparse/0/images.txt", _colmap),
}
"""By the name of ``--read``."""
