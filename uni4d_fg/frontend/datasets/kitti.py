"""KITTI depth: videos from a car, with depth from its lidar, which is sparse.

    val/DRIVE/proj_depth/groundtruth/image_02/0000000005.png        16-bit, 256 per meter, 0 missing
    2011_09_26/DRIVE/image_02/data/0000000005.png
    2011_09_26/DRIVE/image_02/timestamps.txt                        optional
    2011_09_26/calib_cam_to_cam.txt                                 optional: true intrinsics

By ``readme.txt`` and ``depth_read`` of the depth benchmark's development kit, depth is in PNGs of uint16: a value over
256 is meters along the optical axis, and 0 is no value. By the ``readme.txt`` of the raw data's, ``P_rect_02`` is the
3 x 4 projection of the rectified left color camera, of which the first three columns are the intrinsics.

J. Uhrig et al., "Sparsity invariant CNNs", 3DV 2017 (depth); A. Geiger et al., "Vision meets robotics", IJRR 2013.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.datasets.base import (
    Dataset,
    DatasetCard,
    PngDepth,
    first_read,
    frame_number,
    images_of,
    make_video,
    names_of_folders,
    selected,
)
from uni4d_fg.frontend.sequence.model import GroundTruth, Video
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.sequence.selection import FrameSelection
from uni4d_fg.reading import read_text

UNITS_PER_METER = 256.0
FRAME_RATE_HZ = 10.0
DEPTH_URL = "https://s3.eu-central-1.amazonaws.com/avg-kitti/data_depth_annotated.zip"
RAW_URL = "https://s3.eu-central-1.amazonaws.com/avg-kitti/raw_data/DRIVE/DRIVE_sync.zip"
VIDEOS = tuple(
    f"{date}_drive_{drive}_sync"
    for date, drives in (
        ("2011_09_26", ("0002", "0005", "0013", "0020", "0023", "0036", "0079", "0095", "0113")),
        ("2011_09_28", ("0037",)),
        ("2011_09_29", ("0026",)),
        ("2011_09_30", ("0016",)),
        ("2011_10_03", ("0047",)),
    )
    for drive in drives
)
"""The 13 drives of the depth benchmark's validation set, of the left color camera."""
_DEPTH_PATH = Path("proj_depth/groundtruth/image_02")


class KittiDepth(Dataset):
    """The validation drives as the depth archive and the raw archives unpack into one folder."""

    card = DatasetCard(
        name="kitti",
        title="KITTI depth",
        truth=("depth", "intrinsics"),
        convention="the first 110 frames with depth of the 13 validation drives, as MonST3R's prepare_kitti.py",
        urls=(DEPTH_URL, RAW_URL),
        splits={"depth": VIDEOS, "all": None},
        default_split="depth",
        max_depth_m=80.0,
        selection=FrameSelection(stop=110),
    )

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the names of the drives that depth is there of."""
        self.need_folder(root, root)
        return tuple(name for name in names_of_folders(root / "val") if (root / "val" / name / _DEPTH_PATH).is_dir())

    def open(self, root: Path, video: str) -> Video:
        """Open one drive; its frames are those with depth."""
        folder = self.need_folder(root / "val" / video / _DEPTH_PATH, root)
        depths = selected(images_of(folder, (".png",)), self.card.selection)
        date = root / video[:10]
        raw = self.need_folder(date / video / "image_02" / "data", root)
        paths = tuple(self.need_file(raw / path.name, root) for path in depths)
        truth = GroundTruth(intrinsics=_intrinsics(date / "calib_cam_to_cam.txt"))
        times = _times(raw.parent / "timestamps.txt", [frame_number(path) for path in paths])
        opened = make_video(video, folder, paths, times, truth)
        maps = first_read(PngDepth(depths, opened.image_size, UNITS_PER_METER))
        return replace(opened, ground_truth=replace(truth, depths=maps))


def _times(path: Path, numbers: list[int]) -> FloatArray:
    """Return (T,) s from the first: those of the raw data, or 10 Hz where they are not there."""
    if not path.is_file():
        return (np.array(numbers, dtype=np.float64) - numbers[0]) / FRAME_RATE_HZ
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    if numbers[-1] >= len(lines):
        raise SequenceProblem(path, f"has {len(lines)} times, but frame {numbers[-1]} is used", "unpack it again")
    times: FloatArray = np.array([_seconds(path, number, lines[number]) for number in numbers])
    since: FloatArray = times - times[0]
    return since


def _seconds(path: Path, number: int, text: str) -> float:
    """Return the seconds of ``2011-09-26 13:02:25.594360375``, whose ninth decimal Python's own times do not have."""
    whole, _, fraction = text.partition(".")
    try:
        return (datetime.fromisoformat(whole) - datetime(2011, 1, 1)).total_seconds() + float(f"0.{fraction or 0}")
    except ValueError as error:
        raise SequenceProblem(path, f"line {number + 1}: {text[:40]!r} is not a time", "unpack it again") from error


def _intrinsics(path: Path) -> FloatArray | None:
    """Return (4,) fx, fy, cx, cy, px, of the rectified left color camera; None where there is no calibration."""
    if not path.is_file():
        return None
    line = next((line for line in read_text(path).splitlines() if line.startswith("P_rect_02:")), None)
    try:
        matrix = np.array([float(word) for word in (line or "").split()[1:]]).reshape(3, 4)
    except ValueError as error:
        raise SequenceProblem(path, "has no P_rect_02 of 12 numbers", "unpack it again") from error
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise SequenceProblem(path, "P_rect_02 is not a projection", "unpack it again")
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
