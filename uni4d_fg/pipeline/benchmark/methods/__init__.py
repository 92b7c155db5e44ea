"""What other programs wrote, read from their own files and scored like a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uni4d_fg.errors import ConfigError, InputError, Uni4dFgError
from uni4d_fg.frontend.datasets.base import Dataset
from uni4d_fg.frontend.sequence.model import Video
from uni4d_fg.pipeline.benchmark.methods.layouts import LAYOUTS
from uni4d_fg.pipeline.benchmark.score import Estimate, score_estimate
from uni4d_fg.pipeline.benchmark.tables import Method
from uni4d_fg.pipeline.benchmark.task import TaskResult


def read_method(
    text: str,
    dataset: Dataset,
    root: Path,
    videos: tuple[str, ...],
    pose_protocols: tuple[str, ...],
    depth_protocols: tuple[str, ...],
) -> Method:
    """Score what another program wrote about the videos of a dataset.

    Args:
        text: ``LAYOUT:NAME=FOLDER``, or ``LAYOUT=FOLDER`` with the layout's name as that of the row.
        dataset: Whose videos.
        root: Its folder.
        videos: Names; one without output counts as failed.
        pose_protocols: Names.
        depth_protocols: Names.

    Raises:
        ConfigError: If the text is not of that form, or there is no such layout.
    """
    head, equals, folder = text.partition("=")
    layout, _, name = head.partition(":")
    if not equals or not folder or layout not in LAYOUTS:
        raise ConfigError(f"--read {text}: write LAYOUT:NAME=FOLDER with a layout of {', '.join(LAYOUTS)}")
    results = {}
    for video in videos:
        try:
            opened = dataset.open(root, video)
            estimate = _read(layout, Path(folder), video, opened)
            scores = score_estimate(opened, estimate, dataset.card.name, pose_protocols, depth_protocols)
            results[video] = TaskResult("", video, name or layout, None, opened.num_frames, scores)
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
