"""Camera paths for trajectory tools: TUM's and KITTI's text formats, both camera to world."""

from __future__ import annotations

from uni4d_fg.frontend.trajectory_files import write_kitti, write_tum
from uni4d_fg.geometry.trajectory import Trajectory
from uni4d_fg.results.export.model import ExportJob


def write_tum_folder(job: ExportJob) -> None:
    """Write ``trajectory.txt``: time, position, quaternion with the scalar last. Raises OutputError."""
    result = job.run.reconstruction
    write_tum(job.folder / "trajectory.txt", Trajectory(result.timestamps, result.world_T_cam))
    job.facts.append(f"{result.num_frames} poses")
    job.figures["poses"] = result.num_frames


def write_kitti_folder(job: ExportJob) -> None:
    """Write ``poses.txt``, 12 numbers a line, and ``times.txt`` in seconds. Raises OutputError."""
    result = job.run.reconstruction
    write_kitti(job.folder / "poses.txt", result.world_T_cam)
    times = "".join(f"{seconds:.9f}\n" for seconds in result.timestamps.tolist())
    (job.folder / "times.txt").write_text(times, encoding="ascii")
    job.facts.append(f"{result.num_frames} poses")
    job.figures["poses"] = result.num_frames
