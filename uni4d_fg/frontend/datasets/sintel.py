"""MPI-Sintel: rendered film with the truth of everything.

    training/final/VIDEO/frame_0001.png         or clean/
    training/depth/VIDEO/frame_0001.dpt
    training/camdata_left/VIDEO/frame_0001.cam
    training/dynamic_label_perfect/VIDEO/...    optional: what moves, as MonST3R's sintel_get_dynamics.py derives it

D. J. Butler et al., "A naturalistic open source movie for optical flow evaluation", ECCV 2012.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from uni4d_fg.arrays import FloatArray, Int32Array
from uni4d_fg.frontend.datasets.base import (
    Dataset,
    DatasetCard,
    first_read,
    frame_number,
    images_of,
    images_of_truth,
    make_video,
    names_of_folders,
    numbers_without_gap,
)
from uni4d_fg.frontend.datasets.sintel_files import DptDepth, read_cam
from uni4d_fg.frontend.sequence.calibration import MAX_VARIATION
from uni4d_fg.frontend.sequence.decode import read_mask
from uni4d_fg.frontend.sequence.frames import FileFrames
from uni4d_fg.frontend.sequence.model import FrameSource, GroundTruth, Video
from uni4d_fg.frontend.sequence.problems import SequenceProblem

FRAME_RATE_HZ = 24.0

POSE_VIDEOS = (
    "alley_2", "ambush_4", "ambush_5", "ambush_6", "cave_2", "cave_4", "market_2", "market_5", "market_6", "shaman_3",
    "sleeping_1", "sleeping_2", "temple_2", "temple_3",
)  # fmt: skip
"""The 14 videos that ParticleSfM scores poses on, and LEAP-VO, MonST3R and Uni4D after it: in the others the camera
stands still or moves along a straight line."""

DEPTH_VIDEOS = (
    "alley_1", "alley_2", "ambush_2", "ambush_4", "ambush_5", "ambush_6", "ambush_7", "bamboo_1", "bamboo_2",
    "bandage_1", "bandage_2", "cave_2", "cave_4", "market_2", "market_5", "market_6", "mountain_1", "shaman_2",
    "shaman_3", "sleeping_1", "sleeping_2", "temple_2", "temple_3",
)  # fmt: skip
"""All 23 videos of the training set, on which MonST3R (``--full_seq``) and Uni4D score depth."""

IMAGES_URL = "http://files.is.tue.mpg.de/sintel/MPI-Sintel-training_images.zip"
DEPTH_URL = "http://files.is.tue.mpg.de/jwulff/sintel/MPI-Sintel-depth-training-20150305.zip"

Render = Literal["final", "clean"]


class Sintel(Dataset):
    """One of the two renderings.

    Args:
        render: 'final', with blur and atmosphere, as in the field's tables; or 'clean'.
    """

    def __init__(self, render: Render = "final") -> None:
        self.render = render
        self.card = DatasetCard(
            name="sintel" if render == "final" else "sintel-clean",
            title=f"Sintel ({render})",
            truth=("poses", "depth", "intrinsics"),
            convention="all frames; poses of LEAP-VO's split (14 videos), depth of all 23, as MonST3R and Uni4D",
            urls=(IMAGES_URL, DEPTH_URL),
            splits={"pose": POSE_VIDEOS, "depth": DEPTH_VIDEOS, "all": None},
            default_split="pose",
            max_depth_m=70.0,
        )

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the names of the videos of this rendering."""
        return names_of_folders(self._base(root) / self.render)

    def open(self, root: Path, video: str) -> Video:
        """Open one video; truth is poses, depth and intrinsics, and masks where they were derived.

        Intrinsics are the mean over the frames, also where the film zooms; :meth:`notes` then says by how much.
        """
        base = self._base(root)
        folder = self.need_folder(base / self.render / video, root)
        paths = images_of(folder, (".png",))
        numbers_without_gap(paths)
        depth, cameras, moving = (base / name / video for name in ("depth", "camdata_left", "dynamic_label_perfect"))
        self.need_folder(depth, root)
        self.need_folder(cameras, root)
        images_of_truth(paths, depth, ".dpt")
        names = [path.stem for path in paths]
        matrices, poses = self._cameras(tuple(self.need_file(cameras / f"{n}.cam", root) for n in names))
        depth_paths = tuple(self.need_file(depth / f"{n}.dpt", root) for n in names)
        numbers = np.array([frame_number(path) for path in paths], dtype=np.float64)
        opened = make_video(video, folder, paths, (numbers - numbers[0]) / FRAME_RATE_HZ, GroundTruth())
        masks = _MovingMasks.of(moving, names, opened.image_size) if moving.is_dir() else None
        truth = GroundTruth(
            world_T_cam=poses,
            depths=first_read(DptDepth(depth_paths, opened.image_size)),
            masks=masks,
            intrinsics=_each(matrices).mean(axis=0),
        )
        return replace(opened, ground_truth=truth)

    def notes(self, root: Path, video: str) -> tuple[str, ...]:
        """Say by how much the camera changes along the video, which one camera for all frames cannot express."""
        base = self._base(root)
        frames = images_of(base / self.render / video, (".png",))
        each = _each(self._cameras(tuple(base / "camdata_left" / video / f"{path.stem}.cam" for path in frames))[0])
        mean = each.mean(axis=0)
        if np.abs(each - mean).max() <= MAX_VARIATION * mean[0]:
            return ()
        focal = each[:, 0]
        return (
            f"the film zooms, with focal lengths from {focal.min():.0f} to {focal.max():.0f} px: known intrinsics are "
            f"their mean, {mean[0]:.0f} px, held for all frames",
        )

    def _cameras(self, paths: tuple[Path, ...]) -> tuple[FloatArray, FloatArray]:
        pairs = [read_cam(path) for path in paths]
        return np.stack([matrix for matrix, _ in pairs]), np.stack([pose for _, pose in pairs])

    def _base(self, root: Path) -> Path:
        self.need_folder(root, root)
        inner = root / "training"
        return inner if inner.is_dir() else root


def _each(matrices: FloatArray) -> FloatArray:
    """Return (T, 4) fx, fy, cx, cy, px, of (T, 3, 3) matrices."""
    return np.stack((matrices[:, 0, 0], matrices[:, 1, 1], matrices[:, 0, 2], matrices[:, 1, 2]), axis=1)


class _MovingMasks(FileFrames[Int32Array]):
    """What moves: white in one-channel PNGs. The derived masks lack the last frame, which takes those before it."""

    @classmethod
    def of(cls, folder: Path, names: list[str], size: tuple[int, int]) -> FrameSource[Int32Array]:
        paths = [folder / f"{name}.png" for name in names]
        if not paths[-1].is_file():
            paths[-1] = paths[-2]
        absent = next((path for path in paths if not path.is_file()), None)
        if absent is not None:
            raise SequenceProblem(absent, "no such file", "derive the masks of all frames, or remove the folder")
        return cls(tuple(paths), size)

    def _decode(self, path: Path) -> Int32Array:
        return (read_mask(path) > 0).astype(np.int32)
