"""Thirty damages and more for every loader: files missing, empty, cut, overwritten, or a folder in their place."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import miniatures
import numpy as np
import pytest

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.datasets.registry import find_dataset

TUM, BONN = "rgbd_dataset_freiburg3_walking_xyz", "rgbd_bonn_dataset/rgbd_bonn_balloon2"
DRIVE = "2011_09_26_drive_0002_sync"
LOADERS: dict[str, tuple[Callable[[Path], miniatures.Truth], str, list[str]]] = {
    "sintel": (
        miniatures.sintel, "alley_2",
        [
            "training/final/alley_2/frame_0001.png", "training/final/alley_2/frame_0004.png",
            "training/depth/alley_2/frame_0001.dpt", "training/depth/alley_2/frame_0005.dpt",
            "training/camdata_left/alley_2/frame_0001.cam", "training/camdata_left/alley_2/frame_0006.cam",
            "training/dynamic_label_perfect/alley_2/frame_0003.png",
        ],
    ),
    "tum-dynamics": (
        miniatures.tum, "walking_xyz",
        [
            f"{TUM}/rgb.txt", f"{TUM}/depth.txt", f"{TUM}/groundtruth.txt", f"{TUM}/rgb/1341845948.000000.png",
            f"{TUM}/rgb/1341845948.300000.png", f"{TUM}/depth/1341845948.109000.png",
        ],
    ),
    "bonn": (
        miniatures.bonn, "balloon2",
        [
            f"{BONN}/groundtruth.txt", f"{BONN}/rgb/1341845949.000000.png", f"{BONN}/rgb/1341845949.100000.png",
            f"{BONN}/depth/1341845949.009000.png", f"{BONN}/depth/1341845949.109000.png",
        ],
    ),
    "kitti": (
        miniatures.kitti, DRIVE,
        [
            f"2011_09_26/{DRIVE}/image_02/data/0000000005.png", f"2011_09_26/{DRIVE}/image_02/data/0000000009.png",
            f"2011_09_26/{DRIVE}/image_02/timestamps.txt", "2011_09_26/calib_cam_to_cam.txt",
            f"val/{DRIVE}/proj_depth/groundtruth/image_02/0000000005.png",
            f"val/{DRIVE}/proj_depth/groundtruth/image_02/0000000007.png",
        ],
    ),
    "davis": (
        miniatures.davis, "bear",
        [
            f"DAVIS/{kind}/480p/bear/{name}"
            for kind, suffix in (("JPEGImages", "jpg"), ("Annotations", "png"))
            for name in (f"00000.{suffix}", f"00001.{suffix}", f"00002.{suffix}")
        ],
    ),
}  # fmt: skip
CHANGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "a tenth": lambda data: data[: len(data) // 10],
    "zeros": lambda data: bytes(len(data)),
    "noise": lambda data: np.random.default_rng(1).bytes(len(data)),
    "other text": lambda data: b"this is not what was here\n" * 3,
}
DAMAGES = ("missing", "a folder", *CHANGES)
KITTI_DEPTH = ("0000000005.png", "0000000007.png")
OPTIONAL = ("depth.txt", "timestamps.txt", "calib_cam_to_cam.txt", *(f"image_02/{name}" for name in KITTI_DEPTH))
"""Without these there is less truth, or times at the dataset's rate; KITTI's frames are those with depth."""
SHORTER = ("rgb.txt", "depth.txt", "groundtruth.txt", "timestamps.txt")
"""The first lines of these are a shorter file of the same kind, which may do."""


def use(name: str, root: Path, video: str) -> None:
    """Open a video and read all of it."""
    opened = find_dataset(name).open(root, video)
    for frames in (opened.images, opened.ground_truth.depths, opened.ground_truth.masks):
        for _ in frames or ():
            pass


def said_of(name: str, root: Path, video: str) -> str | None:
    """Return what the error says; None if there is none."""
    try:
        use(name, root, video)
    except InputError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", LOADERS)
def test_every_damage_ends_in_an_error_that_names_the_place(name: str, tmp_path: Path) -> None:
    make, video, targets = LOADERS[name]
    make(tmp_path / "whole")
    use(name, tmp_path / "whole", video)
    tried = 0
    for number, target in enumerate(targets):
        for damage in DAMAGES:
            if (damage in DAMAGES[:2] and target.endswith(OPTIONAL)) or (
                damage == "a tenth" and target.endswith(SHORTER)
            ):
                continue
            root = tmp_path / f"{number}-{damage.replace(' ', '_')}"
            shutil.copytree(tmp_path / "whole", root)
            path = root / target
            assert path.is_file(), f"{target}: the damage has something to hit"
            data = path.read_bytes()
            path.unlink()
            if damage == "a folder":
                path.mkdir()
            elif damage != "missing":
                path.write_bytes(CHANGES[damage](data))
            said = said_of(name, root, video)
            assert said is not None, f"{target}, {damage}: was read"
            assert str(root) in said, (target, damage)
            assert "\n" not in said
            shutil.rmtree(root)
            tried += 1
    assert tried >= 30
