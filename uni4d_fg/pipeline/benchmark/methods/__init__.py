"""What other programs wrote, read from their own files and scored like a run."""

from __future__ import annotations

from pathlib import Path

from uni4d_fg.errors import ConfigError, Uni4dFgError
from uni4d_fg.frontend.datasets.base import Dataset
from uni4d_fg.pipeline.benchmark.methods.layouts import LAYOUTS
from uni4d_fg.pipeline.benchmark.score import score_estimate
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
            estimate = LAYOUTS[layout].read(Path(folder), video, opened)
            scores = score_estimate(opened, estimate, dataset.card.name, pose_protocols, depth_protocols)
            results[video] = TaskResult("", video, name or layout, None, opened.num_frames, scores)
        except Uni4dFgError as error:
            results[video] = TaskResult("", video, name or layout, failed=str(error))
    return Method(name or layout, results, "read", f"read from files in the layout of {layout}")
