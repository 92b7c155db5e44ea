"""The names of the files in the folder of a run, and whether it holds one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from uni4d_fg.errors import InputError
from uni4d_fg.reading import is_present


@dataclass(frozen=True)
class RunFolder:
    """Where each result of one run lies; nothing is created or read."""

    root: Path

    @property
    def reconstruction(self) -> Path:
        """Cameras, landmarks and dynamic trajectories (``.npz``)."""
        return self.root / "reconstruction.npz"

    @property
    def trajectory(self) -> Path:
        """Camera poses in TUM format."""
        return self.root / "trajectory.tum"

    @property
    def depth(self) -> Path:
        """Fused depth (T, H, W), float32 meters (``.npy``)."""
        return self.root / "depth.npy"

    @property
    def confidence(self) -> Path:
        """How sure static depth is, (T, h, w), 8 bits (``.npy``); absent where it is not known."""
        return self.root / "confidence.npy"

    @property
    def summary(self) -> Path:
        """What the run did, as JSON."""
        return self.root / "summary.json"

    @property
    def config(self) -> Path:
        """The configuration used, as YAML."""
        return self.root / "config.yaml"

    @property
    def labels(self) -> Path:
        """The tracks and their labels (``.npz``)."""
        return self.root / "labels.npz"

    @property
    def graphs(self) -> Path:
        """Folder of the solved stages: their factors (``.npz``), and their values as GTSAM writes them."""
        return self.root / "graphs"

    def graph(self, kind: str) -> Path:
        """The last solve of a kind; its values lie beside it (``.initial.values``, ``.final.values``)."""
        return self.graphs / f"{kind}.graph.npz"

    @property
    def static_cloud(self) -> Path:
        """The static point cloud (``.ply``)."""
        return self.root / "clouds" / "static.ply"

    def dynamic_cloud(self, frame: int) -> Path:
        """The dynamic point cloud of one frame (``.ply``)."""
        return self.root / "clouds" / "dynamic" / f"{frame:05d}.ply"

    @property
    def trajectory_picture(self) -> Path:
        """Top and side view of the camera path (``.png``)."""
        return self.root / "pictures" / "trajectory.png"

    @property
    def depth_picture(self) -> Path:
        """Image, depth cue and fused depth of a few frames (``.png``)."""
        return self.root / "pictures" / "depth.png"

    @property
    def scene_picture(self) -> Path:
        """Rendered views of the 4D cloud (``.png``)."""
        return self.root / "pictures" / "scene.png"

    @property
    def report(self) -> Path:
        """One page about the run (``.html``), where it was asked for."""
        return self.root / "report.html"

    @property
    def shared_page(self) -> Path:
        """One page that plays the run (``.html``), where it was asked for."""
        return self.root / "share.html"

    @property
    def films(self) -> Path:
        """Folder of films and stills, where they were asked for."""
        return self.root / "render"

    @property
    def exports(self) -> Path:
        """Folder of the run in the formats of other programs, where they were asked for."""
        return self.root / "export"


def is_finished(folder: RunFolder, *, unfinished: bool = False) -> bool:
    """Tell whether a folder holds a finished run, as far as its names say.

    Args:
        folder: The run's folder.
        unfinished: A run that is going on is no error.

    Raises:
        InputError: If there is no such folder, or it holds no run, or one that is going on.
    """
    root = folder.root
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; give the folder of a run")
    if is_present(folder.reconstruction) and is_present(folder.summary):
        return True
    going_on = (root / "stages").is_dir()
    if unfinished and going_on:
        return False
    if going_on or folder.config.is_file():
        raise InputError(f"{root}: the run is not finished; continue it with its command line and --resume")
    raise InputError(f"{root}: holds no run; give the folder that `uni4d-fg reconstruct` wrote (--out)")
