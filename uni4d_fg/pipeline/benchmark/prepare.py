"""From a task to a sequence: the video of the dataset, the cues it is given, and those that are made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uni4d_fg.arrays import Int32Array
from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.cues.depth_settings import settings_for_depth
from uni4d_fg.cues.gather import gather_cues
from uni4d_fg.cues.plan import MaskSource, plan_cues
from uni4d_fg.errors import Cancelled, InputError, Uni4dFgError
from uni4d_fg.frontend.datasets.registry import find_dataset
from uni4d_fg.frontend.sequence.assemble import as_sequence, check_count, load_tracks, open_depth, open_masks
from uni4d_fg.frontend.sequence.calibration import load_given_intrinsics
from uni4d_fg.frontend.sequence.model import FrameSource, Sequence, Video
from uni4d_fg.frontend.sequence.native import find_native_files
from uni4d_fg.frontend.sequence.resize import resize_video
from uni4d_fg.frontend.sequence.uni4d_layout import find_uni4d_files, has_uni4d_cues
from uni4d_fg.pipeline.benchmark.score import NO_MASKS
from uni4d_fg.pipeline.benchmark.task import Task
from uni4d_fg.progress import Reporter, SilentReporter

_MASK_SOURCES: dict[MaskSource, str] = {
    "given": "by masks of the cues", "card": "by masks of a network", "motion": "by masks from motion", "none": NO_MASKS
}  # fmt: skip


@dataclass(frozen=True)
class Prepared:
    """What a run starts from."""

    video: Video
    """As the dataset has it, with its truth in full size, and with cues."""
    sequence: Sequence
    """What is reconstructed."""
    config: Config
    cues: dict[str, Any] | None
    """What was made of the cues, for the summary."""
    mask_source: str
    """Which pixels of the sequence are static, in words for tables: by whose masks."""


def open_task(task: Task) -> Video:
    """Open the video of a task with the cues that it brings or that lie in the folder of cues.

    Raises:
        InputError: If something is missing or damaged.
    """
    video = find_dataset(task.dataset).open(Path(task.root), task.video)
    folder = None if task.cues is None else Path(task.cues) / task.video
    return video if folder is None or not folder.is_dir() else with_cues(video, folder)


def with_cues(video: Video, folder: Path) -> Video:
    """Return a video with the cues of a folder in the native layout or Uni4D's; images there are not looked at.

    Raises:
        InputError: If a cue cannot be read, or does not fit the video in size or number of frames.
    """
    files = find_uni4d_files(folder) if has_uni4d_cues(folder) else find_native_files(folder)
    count, size = video.num_frames, video.image_size
    changes: dict[str, Any] = {}
    if files.depth is not None:
        changes["depths"] = open_depth(files.depth, size)
        check_count(files.depth, len(changes["depths"]), count)
    if files.masks is not None:
        changes["masks"] = open_masks(files.masks, size)
        check_count(files.masks, len(changes["masks"]), count)
    if files.tracks is not None:
        changes["tracks"] = load_tracks(files, files.tracks, count).to_tracks(count, size)
    if files.intrinsics is not None:
        changes["intrinsics"] = load_given_intrinsics(files.intrinsics, count, size)
    if not changes:
        raise InputError(f"{folder}: holds no cue; put depth_cue/, masks/, tracks.npz or Uni4D's folders there")
    return replace(video, **changes)


def prepare(task: Task, reporter: Reporter | None = None, should_stop: Callable[[], bool] | None = None) -> Prepared:
    """Open the video of a task and make the cues that it lacks, in the folder of its run.

    Raises:
        Uni4dFgError: If something is missing or damaged, or cues cannot be made.
    """
    video, chosen = open_task(task), task.configuration
    truth, changes = video.ground_truth, chosen.changes
    used = video
    if chosen.intrinsics == "known":
        if truth.intrinsics is None:
            raise InputError(f"{task.video}: its true intrinsics are not known; run it with unknown ones")
        used = replace(used, intrinsics=truth.intrinsics)
        changes = (*changes, "input.intrinsics=fixed")
    if chosen.masks == "true":
        if truth.masks is None:
            raise InputError(f"{task.video}: its true masks are not known; run it with masks of the cues")
        used = replace(used, masks=truth.masks)
    if chosen.depth == "motion":
        used = replace(used, depths=None)
    if chosen.tracks == "built_in":
        used = replace(used, tracks=None)
    if chosen.poses == "identity":
        used = replace(used, initial_world_T_cam=np.tile(np.eye(4), (used.num_frames, 1, 1)))
        changes = (*changes, "input.poses=initial")
    if task.max_size is not None:
        used = resize_video(used, task.max_size)
    config = load_config(chosen.preset, changes)
    made = chosen.masks if chosen.masks in ("motion", "none") else None
    plan = plan_cues(used, bare=used.depths is None, masks=made)
    source = "by true masks" if chosen.masks == "true" else _MASK_SOURCES[plan.masks]
    if plan.is_given:
        sequence = as_sequence(replace(used, masks=None) if made == "none" else used)
        return Prepared(video, sequence, settings_for_depth(config, sequence), None, source)
    plan.check()
    sequence, report = gather_cues(
        used, plan, task.run_folder / "cues", config, reporter=reporter or SilentReporter(), should_stop=should_stop,
        track_cache=task.run_folder / "stages",
    )  # fmt: skip
    return Prepared(video, sequence, settings_for_depth(config, sequence), report.to_dict(), source)


def masks_of_run(
    task: Task, reporter: Reporter | None = None, should_stop: Callable[[], bool] | None = None
) -> tuple[FrameSource[Int32Array] | None, str]:
    """Return the masks that the run of a task takes, and in words, by whose masks pixels are static.

    What the run made of the video is read from its folder, or made again; where that fails, as the run did, there are
    no masks.

    Raises:
        Cancelled: If ``should_stop`` turned true.
    """
    try:
        prepared = prepare(task, reporter, should_stop)
    except Cancelled:
        raise
    except Uni4dFgError:
        return None, NO_MASKS
    return prepared.sequence.masks, prepared.mask_source
