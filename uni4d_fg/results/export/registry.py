"""The formats by name."""

from __future__ import annotations

from uni4d_fg.errors import InputError
from uni4d_fg.optional import import_open3d, import_pygltflib, import_rerun
from uni4d_fg.results.export.colmap import write_colmap
from uni4d_fg.results.export.exr import write_exr_depth
from uni4d_fg.results.export.glb import write_glb
from uni4d_fg.results.export.gsplat import write_gsplat
from uni4d_fg.results.export.mesh import write_mesh
from uni4d_fg.results.export.model import Exporter
from uni4d_fg.results.export.nerfstudio import write_nerfstudio
from uni4d_fg.results.export.ply import write_ply_folder
from uni4d_fg.results.export.ply_frames import write_ply_frames
from uni4d_fg.results.export.rrd import write_rrd
from uni4d_fg.results.export.trajectories import write_kitti_folder, write_tum_folder
from uni4d_fg.results.export.uni4d import write_uni4d_results

FORMATS: dict[str, Exporter] = {
    "colmap": Exporter(write_colmap, needs_images=True, has_lens=True),
    "nerfstudio": Exporter(write_nerfstudio, needs_images=True, has_lens=True, require=import_open3d),
    "gsplat": Exporter(write_gsplat, needs_images=True, require=import_open3d),
    "tum": Exporter(write_tum_folder, has_lens=True),
    "kitti": Exporter(write_kitti_folder, has_lens=True),
    "ply": Exporter(write_ply_folder, has_lens=True, require=import_open3d),
    "ply-frames": Exporter(write_ply_frames, needs_images=True, require=import_open3d),
    "mesh": Exporter(write_mesh, needs_images=True, require=import_open3d),
    "exr": Exporter(write_exr_depth, needs_images=True, has_lens=True),
    "glb": Exporter(write_glb, has_lens=True, require=import_pygltflib),
    "rrd": Exporter(write_rrd, needs_images=True, require=import_rerun),
    "uni4d": Exporter(write_uni4d_results, needs_images=True, require=import_open3d),
}


def exporter(name: str) -> Exporter:
    """Return the exporter of a format. Raises InputError if there is none of that name."""
    if name not in FORMATS:
        raise InputError(f"unknown format '{name}'; choose among {', '.join(FORMATS)}")
    return FORMATS[name]
