"""What other programs wrote, read from their own files and scored like a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np

from uni4d_fg.arrays import Int32Array
from uni4d_fg.errors import Cancelled, ConfigError, InputError, Uni4dFgError
from uni4d_fg.frontend.sequence.model import FrameSource, Video
from uni4d_fg.pipeline.benchmark.methods.layouts import LAYOUTS
from uni4d_fg.pipeline.benchmark.prepare import masks_of_run, open_task
from uni4d_fg.pipeline.benchmark.score import NO_MASKS, Estimate, score_estimate
from uni4d_fg.pipeline.benchmark.tables import Method
from uni4d_fg.pipeline.benchmark.task import Task, TaskResult

Masks: TypeAlias = "Callable[[Task], tuple[FrameSource[Int32Array] | None, str]]"
"""Gives the masks of a task's run, and in words, by whose masks pixels are static."""


def read_method(text: str, tasks: list[Task], masks: Masks = masks_of_run) -> Method:
    """Score what another program wrote about the videos of a dataset, by the protocols and masks of runs of them.

    Args:
        text: ``LAYOUT:NAME=FOLDER``, or ``LAYOUT=FOLDER`` with the layout's name as that of the row.
        tasks: One per video, of any configuration; a video without output counts as failed.
        masks: Gives the masks of a task, with which self-consistency is scored; asked only where that can be.

    Raises:
        ConfigError: If the text is not of that form, or there is no such layout.
        Cancelled: If ``masks`` was stopped.
    """
    head, equals, folder = text.partition("=")
    layout, _, name = head.partition(":")
    if not equals or not folder or layout not in LAYOUTS:
        raise ConfigError(f"--read {text}: write LAYOUT:NAME=FOLDER with a layout of {', '.join(LAYOUTS)}")
    results = {}
    for task in tasks:
        video = task.video
        try:
            opened = open_task(task)
            estimate = _read(layout, Path(folder), video, opened)
            labels, source = masks(task) if estimate.has_consistency else (None, NO_MASKS)
            protocols = task.pose_protocols, task.depth_protocols
            scores = score_estimate(opened, estimate, task.dataset, *protocols, labels, source)
            results[video] = TaskResult("", video, name or layout, None, opened.num_frames, scores)
        except Cancelled:
            raise
        except Uni4dFgError as error:
            results[video] = TaskResult("", video, name or layout, failed=str(error))
    return Method(name or layout, results, "read", f"read from files in the layout of {layout}")


_ROTATION_TOLERANCE = 1e-2


def _read(layout: str, folder: Path, video: str, opened: Video) -> Estimate:
    """Read what a program wrote about a video, and make sure that it is cameras.

    Raises:
        InputError: If it is not what the layout says.
    """
    try:
        estimate = LAYOUTS[layout].read(folder, video, opened)
    except (ValueError, TypeError, LookupError, ArithmeticError) as error:
        raise InputError(f"{folder}: {video} is not as {layout} writes it ({error}); run the method again") from error
    problem = _problem(estimate, opened.num_frames)
    if problem:
        raise InputError(f"{folder}: {video}: {problem}; run the method again")
    return estimate


def _problem(estimate: Estimate, num_frames: int) -> str | None:
    """Return what is wrong with cameras, or None; the pose of a frame may be unknown (NaN)."""
    poses, intrinsics = estimate.world_T_cam, estimate.intrinsics
    if poses is not None:
        if poses.shape != (num_frames, 4, 4):
            return f"poses have shape {poses.shape}, expected ({num_frames}, 4, 4)"
        known = poses[~np.isnan(poses).any(axis=(1, 2))]
        if not np.isfinite(known).all():
            return "a pose is infinite"
        turned = known[:, :3, :3]
        deviation = np.abs(turned @ np.swapaxes(turned, 1, 2) - np.eye(3))
        if len(known) and not (deviation.max() < _ROTATION_TOLERANCE and (np.linalg.det(turned) > 0.0).all()):
            return "a pose is not a rigid transform"
    if intrinsics is not None and not (
        intrinsics.shape == (4,) and np.isfinite(intrinsics).all() and (intrinsics[:2] > 0.0).all()
    ):
        return "intrinsics are not fx, fy, cx, cy with positive focal lengths"
    return None
