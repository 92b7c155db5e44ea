"""Bonn RGB-D Dynamic: people, balloons and boxes that move in front of a Kinect-like camera.

    rgbd_bonn_balloon2/rgb.txt, rgb/TIME.png
    rgbd_bonn_balloon2/depth.txt, depth/TIME.png        16-bit, 5000 per meter, 0 missing
    rgbd_bonn_balloon2/groundtruth.txt                  as in the TUM RGB-D benchmark

E. Palazzolo et al., "ReFusion: 3D reconstruction in dynamic environments for RGB-D cameras exploiting residuals",
IROS 2019.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from uni4d_fg.arrays import FloatArray
from uni4d_fg.frontend.datasets.base import (
    Dataset,
    DatasetCard,
    PngDepth,
    first_read,
    images_of,
    make_video,
    names_of_folders,
    selected,
)
from uni4d_fg.frontend.datasets.tum_files import MAX_DIFFERENCE_S, PoseList, associate, intrinsics_of, read_pose_list
from uni4d_fg.frontend.sequence.model import GroundTruth, Video
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.sequence.selection import FrameSelection

PREFIX = "rgbd_bonn_"
UNITS_PER_METER = 5000.0
INTRINSICS = (542.822841, 542.576870, 315.593520, 237.756098)
"""fx, fy, cx, cy of the color camera, px (https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset); its small distortion
(k1 0.0399, k2 -0.0997) is left out, as by everybody."""
URL = "https://www.ipb.uni-bonn.de/html/projects/rgbd_dynamic2019/rgbd_bonn_dataset.zip"
FIVE_VIDEOS = ("balloon2", "crowd2", "crowd3", "person_tracking2", "synchronous")
"""DepthCrafter's five, which MonST3R takes over."""

PoseRule = Literal["rows", "times"]


class Bonn(Dataset):
    """The videos in the dataset's own folders.

    Args:
        poses: 'rows': image i takes row i of the true poses, as MonST3R and Uni4D do, whatever its time; 'times': the
            pose within 0.02 s of the image, and only images that have one.
    """

    def __init__(self, poses: PoseRule = "rows") -> None:
        self.poses = poses
        how = "rows 30 to 139 of the true poses" if poses == "rows" else "true poses associated by time (0.02 s)"
        self.card = DatasetCard(
            name="bonn" if poses == "rows" else "bonn-associated",
            title="Bonn" if poses == "rows" else "Bonn (associated)",
            truth=("poses", "depth", "intrinsics"),
            convention=f"frames 30 to 139 of color and of depth, in the order of their names, {how}",
            urls=(URL,),
            splits={"five": FIVE_VIDEOS, "all": None},
            default_split="five",
            max_depth_m=10.0,
            selection=FrameSelection(start=30, stop=140),
        )

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the names of the videos without what all folders begin with."""
        return tuple(name.removeprefix(PREFIX) for name in names_of_folders(self._base(root), PREFIX))

    def open(self, root: Path, video: str) -> Video:
        """Open one video."""
        folder = self.need_folder(self._base(root) / f"{PREFIX}{video}", root)
        images = selected(images_of(self.need_folder(folder / "rgb", root), (".png",)), self.card.selection)
        depths = selected(images_of(self.need_folder(folder / "depth", root), (".png",)), self.card.selection)
        if len(images) != len(depths):
            raise SequenceProblem(
                folder, f"has {len(images)} images but {len(depths)} depth maps to use", self.remedy(root)
            )
        truth = read_pose_list(self.need_file(folder / "groundtruth.txt", root))
        times = _times(images)
        if self.poses == "rows":
            poses = self._rows(truth, len(images), folder, root)
        else:
            pairs = associate(times, truth.times)
            if not pairs:
                raise SequenceProblem(
                    folder, f"no image is within {MAX_DIFFERENCE_S:g} s of a true pose", self.remedy(root)
                )
            images, depths = (tuple(paths[i] for i, _ in pairs) for paths in (images, depths))
            times, poses = times[[i for i, _ in pairs]], truth.world_T_cam[[j for _, j in pairs]]
        opened = make_video(
            video, folder, images, times, GroundTruth(world_T_cam=poses, intrinsics=intrinsics_of(folder, INTRINSICS))
        )
        maps = first_read(PngDepth(depths, opened.image_size, UNITS_PER_METER))
        return replace(opened, ground_truth=replace(opened.ground_truth, depths=maps))

    def notes(self, root: Path, video: str) -> tuple[str, ...]:
        """Say how far the rows of the true poses are from the images in time."""
        if self.poses != "rows":
            return ()
        folder = self._base(root) / f"{PREFIX}{video}"
        times = _times(selected(images_of(folder / "rgb", (".png",)), self.card.selection))
        rows = self.card.selection.indices(len(times) + self.card.selection.start)
        truth = read_pose_list(folder / "groundtruth.txt")
        there = rows < len(truth.times)  # opening the video says it if any are missing
        apart = float(np.abs(truth.times[rows[there]] - times[there]).max(initial=0.0))
        if apart <= MAX_DIFFERENCE_S:
            return ()
        return (
            f"rows of the true poses are up to {1000 * apart:.0f} ms from their images (bonn-associated pairs them)",
        )

    def _rows(self, truth: PoseList, count: int, folder: Path, root: Path) -> FloatArray:
        start = self.card.selection.start
        if len(truth.times) < start + count:
            raise SequenceProblem(
                folder / "groundtruth.txt",
                f"has {len(truth.times)} poses, but images up to number {start + count - 1} are used",
                self.remedy(root),
            )
        return truth.world_T_cam[start : start + count]

    def _base(self, root: Path) -> Path:
        self.need_folder(root, root)
        inner = root / "rgbd_bonn_dataset"
        return inner if inner.is_dir() else root


def _times(paths: tuple[Path, ...]) -> FloatArray:
    """Return (T,) s, which are the files' names."""
    times = []
    for path in paths:
        try:
            times.append(float(path.stem))
        except ValueError as error:
            raise SequenceProblem(path, "is not named after its time", "unpack the archive again") from error
    return np.array(times)
