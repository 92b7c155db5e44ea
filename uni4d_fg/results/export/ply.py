"""PLY: the static cloud, one cloud of what moves per frame, landmarks; optionally trajectories as line sets."""

from __future__ import annotations

import numpy as np

from uni4d_fg.results.clouds import write_ply
from uni4d_fg.results.export.clouds import moving_cloud, static_cloud
from uni4d_fg.results.export.line_set import LineSet, write_line_set
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.slam.reconstruction import Reconstruction


def write_ply_folder(job: ExportJob) -> None:
    """Write binary PLY files in world coordinates; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    run, result = job.run, job.run.reconstruction
    cloud = static_cloud(run)
    write_ply(job.folder / "static.ply", cloud.points, cloud.colors)
    write_ply(job.folder / "landmarks.ply", result.landmarks, result.landmark_color)
    moving = 0
    for frame in range(run.num_frames):
        part = moving_cloud(run, frame)
        write_ply(job.folder / "dynamic" / f"{frame:05d}.ply", part.points, part.colors)
        moving += len(part.points)
        job.advance(frame + 1)
    job.figures |= {"static_points": len(cloud.points), "dynamic_points": moving}
    job.facts.append(
        f"{len(cloud.points)} static points, {len(result.landmarks)} landmarks, "
        f"{moving} moving points in {run.num_frames} frames"
    )
    if job.options.trajectories:
        lines = trajectory_lines(result)
        write_line_set(job.folder / "trajectories.ply", lines)
        write_line_set(job.folder / "camera_path.ply", camera_lines(result))
        job.facts.append(f"trajectories.ply: {len(lines.edges)} steps of {len(result.dynamic_track)} moving points")


def trajectory_lines(result: Reconstruction) -> LineSet:
    """Return the steps of all moving points; a vertex is one point in one frame, with frame, track and instance."""
    track, frame = np.nonzero(np.isfinite(result.dynamic_points).all(axis=2))
    follows = np.flatnonzero((track[1:] == track[:-1]) & (frame[1:] == frame[:-1] + 1))
    return LineSet(
        points=result.dynamic_points[track, frame],
        colors=result.dynamic_color[track],
        edges=np.stack((follows, follows + 1), axis=1),
        attributes={
            "frame": frame, "track": result.dynamic_track[track], "instance": result.dynamic_instance[track]
        },
    )  # fmt: skip


def camera_lines(result: Reconstruction) -> LineSet:
    """Return the path of the camera center; a vertex is one frame."""
    frames = np.arange(result.num_frames)
    colors = np.tile(np.array([230, 60, 40], dtype=np.uint8), (result.num_frames, 1))
    edges = np.stack((frames[:-1], frames[1:]), axis=1)
    return LineSet(result.world_T_cam[:, :3, 3], colors, edges, {"frame": frames})
