"""Ten scenes of growing difficulty, made when they are first opened: for a benchmark where no dataset is at hand."""

from __future__ import annotations

from pathlib import Path

from uni4d_fg.config.cue_noise import CueNoise
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.errors import OutputError
from uni4d_fg.frontend.datasets.base import Dataset, DatasetCard
from uni4d_fg.frontend.sequence.model import Video
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.reading import is_present

COUNT = 10


def scene_of(step: int, **changes: object) -> SyntheticSceneConfig:
    """Return the scene of a step, 0 the easiest: more movers, noisier depth, tracks and masks, fewer frames a second.

    Args:
        step: From 0 to 9.
        **changes: Fields of the scene to replace.
    """
    hard = step / (COUNT - 1)
    noise = CueNoise(
        track_sigma_px=0.3 + 1.2 * hard,
        outlier_fraction=0.01 + 0.09 * hard,
        depth_flicker=0.02 + 0.08 * hard,
        depth_field=0.01 + 0.05 * hard,
        mask_error_px=1 + round(3 * hard),
        focal_error=0.02 + 0.08 * hard,
    )
    fields = {
        "num_frames": 24, "frame_rate": 30.0 - 20.0 * hard, "objects_per_kind": 1 + round(2 * hard), "seed": step,
        "path": ("handheld", "forward")[step % 2], "noise": noise,
    }  # fmt: skip
    return SyntheticSceneConfig(**{**fields, **changes})  # type: ignore[arg-type]


class SyntheticSeries(Dataset):
    """The scenes as sequences in the native layout."""

    card = DatasetCard(
        name="synthetic",
        title="Synthetic scenes",
        truth=("poses", "depth", "masks", "tracks", "intrinsics"),
        convention="24 frames each, of growing difficulty: movers, noise of depth, tracks and masks, frame rate",
        urls=(),
        splits={"all": None},
        default_split="all",
        max_depth_m=None,
        is_made=True,
    )

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the names of all scenes, made or not."""
        return tuple(f"scene_{step}" for step in range(COUNT))

    def size(self, root: Path, video: str) -> tuple[int, tuple[int, int]]:
        """Return the number of frames of a scene and its (height, width), px, whether it is made yet or not."""
        if video not in self.found(root) or is_present(root / video):
            return super().size(root, video)
        scene = scene_of(_step(video))
        return scene.num_frames, (scene.height, scene.width)

    def open(self, root: Path, video: str) -> Video:
        """Open a scene; it is made and written if it is not there.

        Raises:
            InputError: If what is there is damaged.
            OutputError: If it cannot be written.
            MissingDependencyError: If Open3D cannot be loaded.
        """
        folder = root / video
        if video in self.found(root) and not is_present(folder):
            from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence

            sequence = make_synthetic_sequence(scene_of(_step(video)))
            try:
                write_native(sequence, folder)
            except OutputError:
                if not is_present(folder):  # else another process was faster
                    raise
        return open_video(self.need_folder(folder, root))

    def remedy(self, root: Path) -> str:
        """Return the names there are."""
        return f"the scenes are scene_0 to scene_{COUNT - 1}"


def _step(video: str) -> int:
    return int(video.rpartition("_")[2])
