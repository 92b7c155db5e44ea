"""The point clouds that exports hand on: those of the run, or its points where it has no dense depth."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results import run_clouds
from uni4d_fg.results.fusion.clouds import Cloud
from uni4d_fg.results.run import Run


def static_cloud(run: Run) -> Cloud:
    """Return the cloud of what does not move; the landmarks where the run has no dense depth.

    Raises:
        InputError: If a file of the run or its sequence cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    found, _ = run_clouds.static_cloud(run, run.config.fusion)
    if found is not None:
        return Cloud(found.points.astype(np.float64), found.colors)
    _need_what_clouds_are_made_of(run)
    return Cloud(run.reconstruction.landmarks, run.reconstruction.landmark_color)


def moving_cloud(run: Run, frame: int) -> Cloud:
    """Return the cloud of what moves in one frame; the trajectories' points where the run has no dense depth.

    Raises:
        InputError: If a file of the run or its sequence cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    found = run_clouds.moving_cloud(run, frame, run.config.fusion)
    if found is not None:
        return Cloud(found.points.astype(np.float64), found.colors)
    _need_what_clouds_are_made_of(run)
    result = run.reconstruction
    seen = result.dynamic_observed[:, frame]
    return Cloud(result.dynamic_points[seen, frame], result.dynamic_color[seen])


def _need_what_clouds_are_made_of(run: Run) -> None:
    """Refuse to stand in for a dense cloud that the run's depth would give."""
    if run.folder.depth.exists():
        run.need_sequence()
        run.need_depth("a cloud")
