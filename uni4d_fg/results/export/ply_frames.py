"""A PLY per frame at full resolution: what moves, a point for every pixel, with normals; and the static cloud.

Programs that take sequences of files (Blender's and Houdini's importers, MeshLab, CloudCompare) read them in the order
of their names; ``times.txt`` has the second of each.
"""

from __future__ import annotations

from uni4d_fg.results.clouds import write_ply
from uni4d_fg.results.export.dense import every_moving_pixel, static_cloud_with_normals
from uni4d_fg.results.export.model import ExportJob


def write_ply_frames(job: ExportJob) -> None:
    """Write ``static.ply`` and ``frames/%05d.ply``; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    run = job.run
    run.need_depth("a point for every pixel")
    cloud = static_cloud_with_normals(job)
    write_ply(job.folder / "static.ply", cloud.points, cloud.colors, cloud.normals)
    moving = 0
    for frame in range(run.num_frames):
        part = every_moving_pixel(run, frame)
        write_ply(job.folder / "frames" / f"{frame:05d}.ply", part.points, part.colors, part.normals)
        moving += len(part.points)
        job.advance(frame + 1)
    if run.has_times:
        times = run.reconstruction.timestamps - run.reconstruction.timestamps[0]
        (job.folder / "times.txt").write_text("".join(f"{t:.9f}\n" for t in times.tolist()), encoding="ascii")
    job.figures |= {"static_points": len(cloud.points), "dynamic_points": moving}
    job.facts.append(
        f"{len(cloud.points)} static points, {moving} moving points (every pixel) in {run.num_frames} frames; "
        "all have normals"
    )
