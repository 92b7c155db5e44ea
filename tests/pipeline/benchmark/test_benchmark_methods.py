"""What other programs write is read as they write it."""

from __future__ import annotations

import itertools
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.frontend.sequence.model import ArrayFrames, GroundTruth, Video
from uni4d_fg.pipeline.benchmark.methods import read_method
from uni4d_fg.pipeline.benchmark.methods.exr import read_exr
from uni4d_fg.pipeline.benchmark.methods.files import poses_of_rows
from uni4d_fg.pipeline.benchmark.methods.layouts import LAYOUTS
from uni4d_fg.pipeline.benchmark.score import score_estimate
from uni4d_fg.pipeline.benchmark.task import Configuration, Task

FRAMES, SIZE = 5, (12, 16)
MATRIX = np.array([[20.0, 0.0, 7.5], [0.0, 21.0, 5.5], [0.0, 0.0, 1.0]])


@pytest.fixture
def video(rng: np.random.Generator) -> Video:
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(FRAMES, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(FRAMES, 3))
    depth = rng.uniform(1.0, 5.0, (FRAMES, *SIZE)).astype(np.float32)
    truth = GroundTruth(world_T_cam=poses, depths=ArrayFrames(depth), intrinsics=np.array([20.0, 21.0, 7.5, 5.5]))
    return Video(
        "v", ArrayFrames(np.zeros((FRAMES, *SIZE, 3), np.uint8)), SIZE, 10.0 + np.arange(FRAMES) / 30.0,
        frame_names=tuple(f"im{i}" for i in range(FRAMES)), ground_truth=truth,
    )  # fmt: skip


def poses_of(video: Video) -> np.ndarray:
    assert video.ground_truth.world_T_cam is not None
    return video.ground_truth.world_T_cam


def depth_of(video: Video) -> np.ndarray:
    assert video.ground_truth.depths is not None
    return np.stack(list(video.ground_truth.depths))


def rows(video: Video, *, scalar_first: bool = False) -> str:
    lines = []
    for time, pose in zip(video.timestamps, poses_of(video), strict=True):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        quaternion = (w, x, y, z) if scalar_first else (x, y, z, w)
        lines.append(" ".join(f"{v:.12g}" for v in (time, *pose[:3, 3], *quaternion)))
    return "\n".join(lines) + "\n"


def write_files(folder: Path, video: Video) -> None:
    (folder / "v" / "depth").mkdir(parents=True)
    (folder / "v" / "trajectory.tum").write_text(rows(video))
    for i, depth in enumerate(depth_of(video)):
        np.save(folder / "v" / "depth" / f"{i:03d}.npy", depth)
    np.save(folder / "v" / "K.npy", MATRIX)


def write_monst3r(folder: Path, video: Video) -> None:
    (folder / "v").mkdir()
    (folder / "v" / "pred_traj.txt").write_text(rows(video, scalar_first=True))
    np.savetxt(folder / "v" / "pred_intrinsics.txt", np.tile(MATRIX.ravel(), (FRAMES, 1)), fmt="%.6f")
    for i, depth in enumerate(depth_of(video)):
        np.save(folder / "v" / f"frame_{i:04d}.npy", depth)
        np.save(folder / "v" / f"conf_{i}.npy", depth)


def write_megasam(folder: Path, video: Video) -> None:
    np.savez(
        folder / "v_sgd_cvd_hr.npz", depths=depth_of(video), intrinsic=MATRIX, cam_c2w=poses_of(video),
        images=np.zeros((FRAMES, *SIZE, 3), np.uint8),
    )  # fmt: skip


def exr(depth: np.ndarray, compression: str, kind: str = "f4", channel: bytes = b"Z") -> bytes:
    """A scan-line OpenEXR file, by the description of its layout."""
    height, width = depth.shape
    pixel_type, lines, code = {"f2": 1, "f4": 2}[kind], {"none": 1, "zip": 16}[compression], {"none": 0, "zip": 3}
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channels = channel + b"\0" + struct.pack("<iIii", pixel_type, 0, 1, 1) + b"\0"
    header = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)
    for name, type_name, value in (
        (b"channels", b"chlist", channels), (b"compression", b"compression", bytes([code[compression]])),
        (b"dataWindow", b"box2i", window), (b"displayWindow", b"box2i", window), (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
    ):  # fmt: skip
        header += name + b"\0" + type_name + b"\0" + struct.pack("<i", len(value)) + value
    header += b"\0"
    blocks = []
    for y in range(0, height, lines):
        raw = depth[y : y + lines].astype(f"<{kind}").tobytes()
        data = raw
        if compression == "zip":
            parted = raw[0::2] + raw[1::2]
            steps = bytes([parted[0], *((b - a + 128) % 256 for a, b in itertools.pairwise(parted))])
            data = min(zlib.compress(steps), raw, key=len)
        blocks.append(struct.pack("<ii", y, len(data)) + data)
    at = len(header) + 8 * len(blocks)
    offsets = [at + sum(len(b) for b in blocks[:i]) for i in range(len(blocks))]
    return header + struct.pack(f"<{len(blocks)}Q", *offsets) + b"".join(blocks)


@pytest.mark.parametrize("compression", ["none", "zip"])
@pytest.mark.parametrize("kind", ["f2", "f4"])
def test_exr_is_read_as_its_layout_says(compression: str, kind: str, rng: np.random.Generator) -> None:
    smooth = np.add.outer(np.arange(37.0), np.arange(21.0)).astype(np.float32)  # which zip makes smaller
    for depth in (smooth, rng.uniform(1.0, 5.0, (37, 21)).astype(np.float16).astype(np.float32)):
        data = exr(depth, compression, kind)
        np.testing.assert_array_equal(read_exr(data, "x.exr"), depth)
        for cut in (3, 20, 90, len(data) - 40):
            with pytest.raises(InputError, match=r"x\.exr"):
                read_exr(data[:cut], "x.exr")


def write_vipe(folder: Path, video: Video) -> None:
    for name in ("pose", "depth", "intrinsics"):
        (folder / name).mkdir()
    np.savez(folder / "pose" / "v.npz", data=poses_of(video), inds=np.arange(FRAMES))
    np.savez(folder / "intrinsics" / "v.npz", data=np.tile([20.0, 21.0, 7.5, 5.5], (FRAMES, 1)), inds=np.arange(FRAMES))
    with zipfile.ZipFile(folder / "depth" / "v.zip", "w") as archive:
        for i, depth in enumerate(depth_of(video)):
            archive.writestr(f"{i:05d}.exr", exr(depth, ("none", "zip")[i % 2]))


def write_uni4d(folder: Path, video: Video) -> None:
    base = folder / "v" / "uni4d" / "base"
    base.mkdir(parents=True)
    for i, (pose, depth) in enumerate(zip(poses_of(video), depth_of(video), strict=True)):
        np.savez(base / f"{i:04d}.npz", disp=1.0 / depth, R=pose[:3, :3], t=pose[:3, 3], K=MATRIX)


def write_robust_cvd(folder: Path, video: Video) -> None:
    base = folder / "v" / "R0" / "depth"
    base.mkdir(parents=True)
    extrinsics = poses_of(video)[:, :3] * np.array([1.0, -1.0, -1.0, 1.0])
    np.savez(folder / "v" / "metadata.npz", extrinsics=extrinsics, intrinsics=np.zeros((FRAMES, 4)))
    for i, depth in enumerate(depth_of(video)):
        header = struct.pack("i", SIZE[0]) + struct.pack("i", SIZE[1]) + struct.pack("i", 5) + struct.pack("Q", 4)
        (base / f"frame_{i:06d}.raw").write_bytes(header + (1.0 / depth).astype("<f4").tobytes())


def write_colmap(folder: Path, video: Video) -> None:
    lines = ["# Image list with two lines of data per image:"]
    for i in reversed(range(FRAMES)):
        inverse = np.linalg.inv(poses_of(video)[i])
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        values = " ".join(f"{v:.12g}" for v in (w, x, y, z, *inverse[:3, 3]))
        lines += [f"{i + 7} {values} 1 im{i}.png", "1.5 2.5 -1 3.5 4.5 10"]
    (folder / "v" / "sparse" / "0").mkdir(parents=True)
    (folder / "v" / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")


def write_trajectory(folder: Path, video: Video) -> None:
    (folder / "v.txt").write_text(rows(video))


WRITERS: dict[str, Callable[[Path, Video], None]] = {
    "files": write_files, "monst3r": write_monst3r, "cut3r": write_monst3r, "megasam": write_megasam,
    "vipe": write_vipe, "uni4d": write_uni4d, "casualsam": write_uni4d, "robust-cvd": write_robust_cvd,
    "dpvo": write_trajectory, "leapvo": write_trajectory, "colmap": write_colmap,
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_read_as_it_is_written(layout: str, video: Video, tmp_path: Path) -> None:
    WRITERS[layout](tmp_path, video)
    estimate = LAYOUTS[layout].read(tmp_path, "v", video)
    assert estimate.world_T_cam is not None
    np.testing.assert_allclose(estimate.world_T_cam, poses_of(video), atol=1e-6)
    if layout not in ("dpvo", "leapvo", "colmap"):
        assert estimate.depths is not None
        np.testing.assert_allclose(np.stack(list(estimate.depths)), depth_of(video), rtol=1e-5)
    if layout in ("files", "monst3r", "megasam", "vipe", "uni4d"):
        assert estimate.intrinsics is not None
        np.testing.assert_allclose(estimate.intrinsics, [20.0, 21.0, 7.5, 5.5])
    scores = score_estimate(video, estimate, "sintel", ("sim3",), ("metric",))
    assert scores["poses"]["sim3"]["ate"] == pytest.approx(0.0, abs=1e-6)


def write_plain(folder: Path, video: Video, poses: str, depth: str) -> None:
    """The layout 'files' in one of its forms, each written by its description."""
    base, matrices = folder / "v", poses_of(video)
    (base / "depth").mkdir(parents=True)
    if poses == "c2w.npy":
        np.save(base / "c2w.npy", matrices)
    elif poses in ("poses.txt", "trajectory.kitti"):
        np.savetxt(base / poses, matrices[:, :3].reshape(FRAMES, 12), fmt="%.12e")
    else:
        (folder / poses).write_text(rows(video))
    if depth == "depth.npy":
        np.save(base / "depth.npy", depth_of(video))
        return
    for i, values in enumerate(depth_of(video)):
        path = base / "depth" / f"{i:03d}{depth[-4:]}"
        if depth == ".png":
            Image.fromarray(np.rint(values * 1000.0).astype(np.uint16)).save(path)
        elif depth == ".exr":
            path.write_bytes(exr(values, "zip"))
        elif depth == "depth.npz":
            np.savez(path, depth=values)
        else:
            np.savez(path, disp=1.0 / values)


@pytest.mark.parametrize("poses", ["c2w.npy", "poses.txt", "trajectory.kitti", "v/traj.txt", "v.txt", "v.tum"])
def test_every_form_of_a_trajectory_is_read(poses: str, video: Video, tmp_path: Path) -> None:
    write_plain(tmp_path, video, poses, "depth.npy")
    estimate = LAYOUTS["files"].read(tmp_path, "v", video)
    assert estimate.world_T_cam is not None
    np.testing.assert_allclose(estimate.world_T_cam, poses_of(video), atol=1e-9)


@pytest.mark.parametrize("depth", ["depth.npy", "depth.npz", "disp.npz", ".exr", ".png"])
def test_every_form_of_depth_is_read(depth: str, video: Video, tmp_path: Path) -> None:
    assert video.ground_truth.depths is not None
    values = video.ground_truth.depths[1]
    values[3, 4] = 0.0  # no depth: 0 in every form, also as 1 / depth
    with np.errstate(divide="ignore"):
        write_plain(tmp_path, video, "c2w.npy", depth)
    estimate = LAYOUTS["files"].read(tmp_path, "v", video)
    assert estimate.depths is not None
    found, expected = np.stack(list(estimate.depths)), depth_of(video)
    assert np.argwhere(~np.isfinite(found)).tolist() == [[1, 3, 4]]
    expected[1, 3, 4] = np.nan
    # PNGs hold whole millimeters, the others what they were given.
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=0.00051 if depth == ".png" else 0.0)


def test_files_of_another_number_of_frames_or_kind_are_refused(video: Video, tmp_path: Path) -> None:
    write_plain(tmp_path, video, "poses.txt", ".png")
    np.save(tmp_path / "v" / "depth" / "000.npy", depth_of(video)[0])
    with pytest.raises(InputError, match="files of 2 kinds of depth"):
        LAYOUTS["files"].read(tmp_path, "v", video)
    (tmp_path / "v" / "depth" / "000.npy").unlink()
    np.savetxt(tmp_path / "v" / "poses.txt", poses_of(video)[:4, :3].reshape(4, 12))
    with pytest.raises(InputError, match="has 4 frames, the video 5"):
        LAYOUTS["files"].read(tmp_path, "v", video)


def test_a_model_of_half_of_the_frames_says_so(video: Video, tmp_path: Path) -> None:
    write_colmap(tmp_path, video)
    path = tmp_path / "v" / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:7]) + "\n")  # the last three of five frames
    scores = score_estimate(video, LAYOUTS["colmap"].read(tmp_path, "v", video), "sintel", ("sim3",), ())
    assert scores["poses"]["sim3"]["ate"] == pytest.approx(0.0, abs=1e-6)
    assert scores["posed"] == {"posed": 3, "frames": 5}
    path.write_text("\n".join(lines[:3]) + "\n")
    scores = score_estimate(video, LAYOUTS["colmap"].read(tmp_path, "v", video), "sintel", ("sim3",), ())
    assert (scores["poses"], scores["posed"]) == ({}, {"posed": 1, "frames": 5})


def test_rows_by_time_or_number_belong_to_their_frames(video: Video) -> None:
    every = np.array([[float(v) for v in line.split()] for line in rows(video).splitlines()])
    some = poses_of_rows(Path("x"), every[[0, 3]], video.timestamps, scalar_first=False)
    assert np.isfinite(some).all(axis=(1, 2)).tolist() == [True, False, False, True, False]
    numbered = every[[1, 2]].copy()
    numbered[:, 0] = (1.0, 2.0)
    by_number = poses_of_rows(Path("x"), numbered, video.timestamps, scalar_first=False)
    assert np.isfinite(by_number).all(axis=(1, 2)).tolist() == [False, True, True, False, False]
    late = every[[0, 1]].copy()
    late[:, 0] += 500.5
    with pytest.raises(InputError, match="neither their times nor their numbers"):
        poses_of_rows(Path("x"), late, video.timestamps, scalar_first=False)
    with pytest.raises(InputError, match="unit length"):
        poses_of_rows(Path("x"), every * 2.0, video.timestamps, scalar_first=False)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_empty_folder_is_an_error_that_names_it(layout: str, video: Video, tmp_path: Path) -> None:
    (tmp_path / "v").mkdir()
    with pytest.raises(InputError, match=str(tmp_path)):
        LAYOUTS[layout].read(tmp_path, "v", video)


@pytest.mark.parametrize(
    ("layout", "damage"),
    [
        ("monst3r", "v/frame_0003.npy"), ("uni4d", "v/uni4d/base/0003.npz"), ("files", "v/depth/003.npy"),
        ("robust-cvd", "v/R0/depth/frame_000003.raw"),
    ],
)  # fmt: skip
def test_a_missing_frame_is_an_error(layout: str, damage: str, video: Video, tmp_path: Path) -> None:
    WRITERS[layout](tmp_path, video)
    (tmp_path / damage).unlink()
    with pytest.raises(InputError, match="4 files"):
        LAYOUTS[layout].read(tmp_path, "v", video)


@pytest.mark.parametrize("text", ["monst3r", "nosuch=/x", "monst3r:a=", ":=x"])
def test_a_wrong_option_is_explained(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="LAYOUT:NAME=FOLDER"):
        read_method(text, [Task("sintel", str(tmp_path), "v", Configuration("x"), str(tmp_path))])
