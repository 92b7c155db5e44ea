"""A folder of sequences of one's own: each in the native layout, in Uni4D's, or just images or a video file."""

from __future__ import annotations

from pathlib import Path

from uni4d_fg.frontend.datasets.base import Dataset, DatasetCard, names_of_folders
from uni4d_fg.frontend.sequence.layout import Layout, LayoutOptions, find_images
from uni4d_fg.frontend.sequence.model import Video
from uni4d_fg.frontend.sequence.open_video import open_video


class SequenceFolders(Dataset):
    """Every subfolder with frames is a video, with the cues that it brings.

    Args:
        layout: Of the subfolders.
        true_depth_units_per_meter: Of PNGs in ``depth_gt/`` of Uni4D's layout: 5000 of Bonn and TUM, 256 of KITTI.
    """

    def __init__(self, layout: Layout = "auto", true_depth_units_per_meter: float = 1000.0) -> None:
        self.options: LayoutOptions = {}
        if layout == "uni4d":
            self.options["depth_gt_scale"] = true_depth_units_per_meter
        self.layout = layout
        self.card = DatasetCard(
            name="native" if layout != "uni4d" else "uni4d",
            title="Sequences" if layout != "uni4d" else "Sequences as Uni4D prepares them",
            truth=("poses", "depth", "masks", "tracks", "intrinsics"),
            convention="every subfolder with frames, all frames, and the truth that is there",
            urls=(),
            splits={"all": None},
            default_split="all",
            max_depth_m=70.0,
        )

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the names of the subfolders that hold frames."""
        self.need_folder(root, root)
        return tuple(name for name in names_of_folders(root) if find_images(root / name) is not None)

    def open(self, root: Path, video: str) -> Video:
        """Open one sequence with its cues."""
        return open_video(self.need_folder(root / video, root), layout=self.layout, **self.options)

    def remedy(self, root: Path) -> str:
        """Return what to put there."""
        return f"put one folder per sequence into {root}"
