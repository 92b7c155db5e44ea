"""Small videos in the exact layout of the datasets, written from their documentation and not by the package."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

HEIGHT, WIDTH = 48, 64


@dataclass(frozen=True)
class Truth:
    """What was written of the frames that the dataset's convention uses."""

    names: list[str]
    times: np.ndarray
    images: np.ndarray
    depths: np.ndarray
    poses: np.ndarray
    intrinsics: np.ndarray
    masks: np.ndarray


def content(count: int, seed: int = 3) -> Truth:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    return Truth(
        [], np.arange(count) / 30.0, rng.integers(0, 256, (count, HEIGHT, WIDTH, 3), dtype=np.uint8),
        rng.uniform(0.5, 9.0, (count, HEIGHT, WIDTH)).astype(np.float32), poses, np.array([70.0, 71.0, 31.0, 24.0]),
        rng.integers(0, 3, (count, HEIGHT, WIDTH)).astype(np.int32),
    )  # fmt: skip


def part(truth: Truth, frames: np.ndarray, names: list[str]) -> Truth:
    return Truth(
        [names[i] for i in frames], truth.times[frames], truth.images[frames], truth.depths[frames],
        truth.poses[frames], truth.intrinsics, truth.masks[frames],
    )  # fmt: skip


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def write(path: Path, data: bytes | str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def dpt(depth: np.ndarray) -> bytes:
    height, width = depth.shape
    return struct.pack("<fii", 202021.25, width, height) + struct.pack(f"<{depth.size}f", *depth.ravel().tolist())


def cam(matrix: np.ndarray, pose: np.ndarray) -> bytes:
    extrinsics = np.linalg.inv(pose)[:3]
    return struct.pack("<f21d", 202021.25, *matrix.ravel().tolist(), *extrinsics.ravel().tolist())


def sintel(root: Path, video: str = "alley_2") -> Truth:
    truth = content(6)
    fx, fy, cx, cy = truth.intrinsics
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    names = [f"frame_{i + 1:04d}" for i in range(6)]
    for i, name in enumerate(names):
        save(root / "training" / "final" / video / f"{name}.png", truth.images[i])
        save(root / "training" / "clean" / video / f"{name}.png", 255 - truth.images[i])
        write(root / "training" / "depth" / video / f"{name}.dpt", dpt(truth.depths[i]))
        write(root / "training" / "camdata_left" / video / f"{name}.cam", cam(matrix, truth.poses[i]))
        if i < 5:  # the derived masks lack the last frame
            moving = np.where(truth.masks[i] > 0, 255, 0).astype(np.uint8)
            save(root / "training" / "dynamic_label_perfect" / video / f"{name}.png", moving)
    return part(truth, np.arange(6), names)


def rgbd(folder: Path, count: int, pose_shift: float = 0.004) -> Truth:
    """A folder of the TUM RGB-D benchmark; poses come 10 times as often as images, as from a motion capture system."""
    truth = content(count)
    clock = 1341845948.0 + truth.times
    names = [f"{time:.6f}" for time in clock]
    rgb, depth = ["# color images\n# file: 'x.bag'\n# timestamp filename\n"], ["# depth maps\n"]
    for i, name in enumerate(names):
        save(folder / "rgb" / f"{name}.png", truth.images[i])
        later = f"{clock[i] + 0.009:.6f}"
        save(folder / "depth" / f"{later}.png", np.rint(truth.depths[i] * 5000.0).astype(np.uint16))
        rgb.append(f"{name} rgb/{name}.png\n")
        depth.append(f"{later} depth/{later}.png\n")
    lines = ["# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"]
    for i, pose in enumerate(truth.poses):
        position, quaternion = pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat()
        numbers = " ".join(f"{value:.9f}" for value in (*position, *quaternion))
        lines.append(f"{clock[i] + pose_shift:.4f} {numbers}\n")
    write(folder / "rgb.txt", "".join(rgb))
    write(folder / "depth.txt", "".join(depth))
    write(folder / "groundtruth.txt", "".join(lines))
    return Truth(names, clock, truth.images, truth.depths, truth.poses, truth.intrinsics, truth.masks)


def tum(root: Path, video: str = "walking_xyz") -> Truth:
    truth = rgbd(root / f"rgbd_dataset_freiburg3_{video}", 16)
    return part(truth, np.arange(0, 16, 3), truth.names)


def bonn(root: Path, video: str = "balloon2") -> Truth:
    truth = rgbd(root / "rgbd_bonn_dataset" / f"rgbd_bonn_{video}", 36)
    return part(truth, np.arange(30, 36), truth.names)


def kitti(root: Path, video: str = "2011_09_26_drive_0002_sync") -> Truth:
    truth, sparse = content(11), np.random.default_rng(4).random((11, HEIGHT, WIDTH)) < 0.2
    truth.depths[~sparse] = np.nan
    names = [f"{i:010d}" for i in range(11)]
    date, stamps = video[:10], []
    for i, name in enumerate(names):
        save(root / date / video / "image_02" / "data" / f"{name}.png", truth.images[i])
        stamps.append(f"2011-09-26 13:02:2{i // 10}.{i % 10}94360375\n")
        if i >= 5:  # the depth of the first and last five frames was not accumulated
            values = np.rint(np.nan_to_num(truth.depths[i]) * 256.0).astype(np.uint16)
            save(root / "val" / video / "proj_depth" / "groundtruth" / "image_02" / f"{name}.png", values)
    write(root / date / video / "image_02" / "timestamps.txt", "".join(stamps))
    fx, fy, cx, cy = truth.intrinsics
    write(root / date / "calib_cam_to_cam.txt", f"P_rect_02: {fx} 0 {cx} 45.0 0 {fy} {cy} -0.3 0 0 1 0.005\n")
    used = part(truth, np.arange(5, 11), names)
    return Truth(used.names, np.arange(6) * 0.1, *list(used.__dict__.values())[2:])


def davis(root: Path, video: str = "bear") -> Truth:
    truth = content(4)
    palette = np.zeros((256, 3), np.uint8)
    palette[1:3] = ((128, 0, 0), (0, 128, 0))
    names = [f"{i:05d}" for i in range(4)]
    for i, name in enumerate(names):
        path = root / "DAVIS" / "JPEGImages" / "480p" / video / f"{name}.jpg"
        save(path, truth.images[i])
        mask = Image.fromarray(truth.masks[i].astype(np.uint8), "P")
        mask.putpalette(palette.ravel().tolist())
        annotation = root / "DAVIS" / "Annotations" / "480p" / video / f"{name}.png"
        annotation.parent.mkdir(parents=True, exist_ok=True)
        mask.save(annotation)
    return part(truth, np.arange(4), names)
