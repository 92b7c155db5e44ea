"""TUM-dynamics: the eight videos of the TUM RGB-D benchmark (freiburg3) in which people sit or walk.

    rgbd_dataset_freiburg3_walking_xyz/rgb.txt, rgb/TIME.png
    rgbd_dataset_freiburg3_walking_xyz/depth.txt, depth/TIME.png       16-bit, 5000 per meter, 0 missing
    rgbd_dataset_freiburg3_walking_xyz/groundtruth.txt

J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from uni4d_fg.frontend.datasets.base import Dataset, DatasetCard, PngDepth, first_read, make_video, names_of_folders
from uni4d_fg.frontend.datasets.tum_files import (
    MAX_DIFFERENCE_S,
    associate,
    intrinsics_of,
    read_file_list,
    read_pose_list,
)
from uni4d_fg.frontend.sequence.model import GroundTruth, Video
from uni4d_fg.frontend.sequence.problems import SequenceProblem
from uni4d_fg.frontend.sequence.selection import FrameSelection

PREFIX = "rgbd_dataset_freiburg3_"
UNITS_PER_METER = 5000.0
INTRINSICS = (535.4, 539.2, 320.1, 247.6)
"""fx, fy, cx, cy of the freiburg3 color camera, px; its images are undistorted already
(https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats). Uni4D's program takes 525, 525, 319.5, 239.5."""
URL = "https://cvg.cit.tum.de/rgbd/dataset/freiburg3/"
VIDEOS = (
    "sitting_static", "sitting_xyz", "sitting_halfsphere", "sitting_rpy", "walking_static", "walking_xyz",
    "walking_halfsphere", "walking_rpy",
)  # fmt: skip


class TumDynamics(Dataset):
    """The videos in the benchmark's own folders."""

    card = DatasetCard(
        name="tum-dynamics",
        title="TUM-dynamics",
        truth=("poses", "depth", "intrinsics"),
        convention=(
            "color images associated with true poses (0.02 s), every third of them, the first 90, as MonST3R's "
            "prepare_tum.py"
        ),
        urls=(f"{URL}{PREFIX}{{sitting,walking}}_{{static,xyz,halfsphere,rpy}}.tgz",),
        splits={"pose": VIDEOS, "all": None},
        default_split="pose",
        max_depth_m=10.0,
        selection=FrameSelection(stop=270, stride=3),
    )

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the names of the videos without what all folders begin with."""
        self.need_folder(root, root)
        return tuple(name.removeprefix(PREFIX) for name in names_of_folders(root, PREFIX))

    def open(self, root: Path, video: str) -> Video:
        """Open one video; the true depth of a frame is that within 0.02 s, if there is one."""
        folder = self.need_folder(root / f"{PREFIX}{video}", root)
        colors = read_file_list(self.need_file(folder / "rgb.txt", root))
        poses = read_pose_list(self.need_file(folder / "groundtruth.txt", root))
        pairs = associate(colors.times, poses.times)
        if not pairs:
            raise SequenceProblem(
                folder, f"no image is within {MAX_DIFFERENCE_S:g} s of a true pose", self.remedy(root)
            )
        chosen = [pairs[int(i)] for i in self.card.selection.indices(len(pairs))]
        image, pose = np.array(chosen).T
        paths = tuple(self.need_file(colors.paths[int(i)], root) for i in image)
        truth = GroundTruth(world_T_cam=poses.world_T_cam[pose], intrinsics=intrinsics_of(folder, INTRINSICS))
        opened = make_video(video, folder, paths, colors.times[image], truth)
        if not (folder / "depth.txt").is_file():
            return opened
        depths = read_file_list(folder / "depth.txt")
        nearest = dict(associate(opened.timestamps, depths.times))
        files = tuple(
            self.need_file(depths.paths[nearest[i]], root) if i in nearest else None for i in range(len(paths))
        )
        maps = first_read(PngDepth(files, opened.image_size, UNITS_PER_METER))
        return replace(opened, ground_truth=replace(truth, depths=maps))
