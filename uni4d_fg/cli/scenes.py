"""Synthetic scenes as folders."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from uni4d_fg.config.load import dump_config, read_yaml, with_overrides
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.errors import ConfigError, InputError, OutputError
from uni4d_fg.files import atomic_write_text
from uni4d_fg.frontend.measurements.imu import write_imu
from uni4d_fg.frontend.sequence.model import Sequence as VideoSequence
from uni4d_fg.frontend.sequence.write import write_native, write_uni4d

SCENE_FILE = "scene.yaml"


def scene_config(named: Mapping[str, Any], changes: Sequence[str]) -> SyntheticSceneConfig:
    """Return the default scene with named options (None: not given) and ``FIELD=VALUE`` changes applied.

    Raises:
        ConfigError: If a field is unknown or a value not allowed.
    """
    given = [f"{name}={value}" for name, value in named.items() if value is not None]
    return with_overrides(SyntheticSceneConfig(), [*given, *changes])


def write_scene(
    scene: SyntheticSceneConfig, folder: Path, layout: str = "native", *, imu: bool = False
) -> VideoSequence:
    """Make a scene and write it, with its parameters in ``scene.yaml`` and, if wanted, the samples of an IMU.

    Raises:
        InputError: If the video is too short for an IMU.
        OutputError: If the folder is in the way or cannot be written.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    from uni4d_fg.frontend.synthetic.imu import MIN_POSES, simulate_imu
    from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence

    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise OutputError(f"cannot write {folder}: it exists already; remove it or choose another folder")
    if imu and scene.num_frames < MIN_POSES:
        raise InputError(f"--imu: the path of an IMU needs {MIN_POSES} frames, got {scene.num_frames}")
    sequence = make_synthetic_sequence(scene)
    samples = None
    if imu and sequence.ground_truth.world_T_cam is not None:
        samples = simulate_imu(sequence.timestamps, sequence.ground_truth.world_T_cam, seed=scene.seed).samples
    write = write_uni4d if layout == "uni4d" else write_native
    write(sequence, folder)
    atomic_write_text(folder / SCENE_FILE, dump_config(scene))
    if samples is not None:
        write_imu(samples, folder)
    return sequence


CUES = "cues"
"""Folder beside the videos of a dataset that holds the cues of each, by its name."""


def write_scene_as(scene: SyntheticSceneConfig, root: Path, dataset: str, video: str | None) -> tuple[str, int]:
    """Make a scene and write it as one more video of a dataset, its noisy cues into ``cues/VIDEO`` beside it.

    Args:
        scene: What to make.
        root: Folder of the dataset, made if absent.
        dataset: A name of :data:`~uni4d_fg.frontend.datasets.writers.WRITERS`.
        video: Its name; None takes the first of the dataset's default split that is not there.

    Returns:
        The name of the video, and how many of its frames the dataset's convention uses.

    Raises:
        ConfigError: If there is no such layout.
        InputError: If the scene has too few frames for the dataset's convention.
        OutputError: If the video is there already or cannot be written.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    from uni4d_fg.frontend.datasets.registry import find_dataset
    from uni4d_fg.frontend.datasets.writers import WRITERS
    from uni4d_fg.frontend.sequence.assemble import as_sequence, as_video
    from uni4d_fg.frontend.sequence.selection import select_frames
    from uni4d_fg.frontend.sequence.write import write_cues
    from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence

    if dataset not in WRITERS:
        raise ConfigError(f"--as {dataset}: there is no such layout; choose one of {', '.join(WRITERS)}")
    known = find_dataset({"tum": "tum-dynamics"}.get(dataset, dataset))
    there = known.found(root) if root.is_dir() else ()
    names = known.card.splits[known.card.default_split] or ()
    name = video or next((n for n in names if n not in there and not (root / CUES / n).exists()), None)
    if name is None:
        raise OutputError(f"{root}: all videos of {known.card.title} are there; name another with --video")
    if name in there or (root / CUES / name).exists():
        raise OutputError(f"{root}: the video {name} is there already; name another with --video")
    used = known.card.selection.indices(scene.num_frames)
    if len(used) < 2:
        raise InputError(
            f"--frames {scene.num_frames}: {known.card.title} uses {known.card.convention}; make more frames"
        )
    sequence = make_synthetic_sequence(scene)
    WRITERS[dataset](sequence, root, name)
    write_cues(as_sequence(select_frames(as_video(sequence), known.card.selection)), root / CUES / name)
    atomic_write_text(root / CUES / f"{name}.yaml", dump_config(scene))
    return name, len(used)


_SCENE_FILES = re.compile(
    r"scene\.yaml|K\.npy|c2w\.npy|timestamps\.txt|world_T_cam_init\.npy|tracks\.npz|ground_truth\.npz"
    r"|(depth_cue|depth_gt)\.npy|(rgb|masks|masks_gt|depth_cue|depth_gt)/\d+\.png"
)


def _remove_scene(folder: Path) -> None:
    """Remove the files of a synthetic scene in the native layout.

    Raises:
        OutputError: If there is anything else in the folder, or a file cannot be removed.
    """
    files = [path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir()]
    foreign = [path for path in files if not _SCENE_FILES.fullmatch(path.relative_to(folder).as_posix())]
    if foreign:
        raise OutputError(f"{foreign[0]}: is not of the scene that is to be replaced; move it or choose another folder")
    shutil.rmtree(folder)


def reuse_or_write_scene(scene: SyntheticSceneConfig, folder: Path) -> bool:
    """Make sure that ``folder`` holds this scene in the native layout; another synthetic scene is replaced.

    Returns:
        Whether the scene that was there was of the same parameters and is used again.

    Raises:
        OutputError: If the folder holds anything else, or cannot be written.
    """
    if (folder / SCENE_FILE).is_file():
        try:
            known = read_yaml(folder / SCENE_FILE)
        except ConfigError:
            known = None
        if known == scene.model_dump(mode="json"):
            return True
        _remove_scene(folder)
    write_scene(scene, folder)
    return False
