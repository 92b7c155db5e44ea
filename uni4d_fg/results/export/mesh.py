"""The static scene as a mesh (``mesh.ply``) with colors and normals."""

from __future__ import annotations

from uni4d_fg.errors import OutputError
from uni4d_fg.optional import import_open3d
from uni4d_fg.results.export.model import ExportJob
from uni4d_fg.results.mesh import Volume, static_mesh


def write_mesh(job: ExportJob) -> None:
    """Write ``mesh.ply``; errors as in :func:`uni4d_fg.results.export.run.export_run`."""
    open3d, run, result = import_open3d(), job.run, job.run.reconstruction
    depths, sequence = run.need_depth("a mesh"), run.need_sequence()
    volume = Volume.of(depths, float(result.frame_intrinsics[:, 0].mean()))
    mesh = static_mesh(sequence, depths, result, run.config.fusion, volume, done=job.advance)
    path = job.folder / "mesh.ply"
    if not mesh.has_triangles():
        raise OutputError(f"{path}: the depth of this run holds no surface")
    quiet = open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error)
    with quiet:
        if not open3d.io.write_triangle_mesh(str(path), mesh) or len(
            open3d.io.read_triangle_mesh(str(path)).triangles
        ) != len(mesh.triangles):
            raise OutputError(f"cannot write {path}: Open3D failed; check free space and the folder's permissions")
    vertices, triangles = len(mesh.vertices), len(mesh.triangles)
    job.figures |= {"vertices": vertices, "triangles": triangles, "voxel_m": volume.voxel_m}
    job.facts.append(
        f"mesh.ply: {vertices} vertices, {triangles} triangles, voxels of {1000 * volume.voxel_m:.1f} mm, "
        f"up to {volume.farthest_m:.1f} m from the cameras"
    )
