"""The point clouds of a run: as it wrote them, or else built anew from its depth."""

from __future__ import annotations

from uni4d_fg.export.source import RunSource
from uni4d_fg.fusion.clouds import Cloud, dynamic_cloud
from uni4d_fg.fusion.clouds import static_cloud as build_static_cloud
from uni4d_fg.reconstruction.clouds import read_ply


def static_cloud(source: RunSource) -> Cloud:
    """Return the cloud of what does not move; the landmarks where the run has no dense depth.

    Raises:
        InputError: If a file of the run or its sequence cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    if source.folder.static_cloud.exists():
        return Cloud(*read_ply(source.folder.static_cloud))
    result = source.reconstruction
    if source.depth is None:
        return Cloud(result.landmarks, result.landmark_color)
    sequence = source.sequence
    return build_static_cloud(
        sequence.images, source.depth, sequence.masks, result.intrinsics, result.world_T_cam, source.config.fusion
    )


def moving_cloud(source: RunSource, frame: int) -> Cloud:
    """Return the cloud of what moves in one frame; the trajectories' points where the run has no dense depth.

    Raises:
        InputError: If a file of the run or its sequence cannot be read.
        MissingDependencyError: If Open3D cannot be loaded.
    """
    path = source.folder.dynamic_cloud(frame)
    if path.exists():
        return Cloud(*read_ply(path))
    result = source.reconstruction
    if source.depth is None:
        seen = result.dynamic_observed[:, frame]
        return Cloud(result.dynamic_points[seen, frame], result.dynamic_color[seen])
    sequence = source.sequence
    return dynamic_cloud(
        sequence.images[frame], source.depth[frame], sequence.masks[frame],
        result.intrinsics, result.world_T_cam[frame], source.config.fusion,
    )  # fmt: skip
