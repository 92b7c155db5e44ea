"""The point clouds of a run: as it wrote them, or else built anew from its depth."""

from __future__ import annotations

from uni4d_fg.results.clouds import read_ply
from uni4d_fg.results.fusion.clouds import Cloud, dynamic_cloud
from uni4d_fg.results.fusion.clouds import static_cloud as build_static_cloud
from uni4d_fg.results.run import Run


def static_cloud(run: Run) -> Cloud:
    """Return the cloud of what does not move; the landmarks where the run has no dense depth.

    Raises:
        InputError: If a file of the run or its sequence cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    if run.folder.static_cloud.exists():
        return Cloud(*read_ply(run.folder.static_cloud))
    result = run.reconstruction
    if not run.folder.depth.exists():
        return Cloud(result.landmarks, result.landmark_color)
    sequence, depth = run.need_sequence(), run.need_depth("a cloud")
    return build_static_cloud(
        sequence.images, depth, sequence.masks, result.intrinsics, result.world_T_cam, run.config.fusion,
        lens=result.lens,
    )  # fmt: skip


def moving_cloud(run: Run, frame: int) -> Cloud:
    """Return the cloud of what moves in one frame; the trajectories' points where the run has no dense depth.

    Raises:
        InputError: If a file of the run or its sequence cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    path = run.folder.dynamic_cloud(frame)
    if path.exists():
        return Cloud(*read_ply(path))
    result = run.reconstruction
    if not run.folder.depth.exists():
        seen = result.dynamic_observed[:, frame]
        return Cloud(result.dynamic_points[seen, frame], result.dynamic_color[seen])
    sequence, depth = run.need_sequence(), run.need_depth("a cloud")
    return dynamic_cloud(
        sequence.images[frame], depth[frame], sequence.masks[frame],
        result.intrinsics, result.world_T_cam[frame], run.config.fusion, result.lens,
    )  # fmt: skip
