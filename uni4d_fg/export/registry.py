"""The formats by name."""

from __future__ import annotations

from uni4d_fg.errors import InputError
from uni4d_fg.export.colmap import write_colmap
from uni4d_fg.export.model import Exporter
from uni4d_fg.export.nerfstudio import write_nerfstudio
from uni4d_fg.export.ply import write_ply_folder
from uni4d_fg.export.rrd import write_rrd
from uni4d_fg.export.trajectories import write_kitti_folder, write_tum_folder
from uni4d_fg.export.uni4d import write_uni4d_results
from uni4d_fg.optional import import_open3d, import_rerun

FORMATS: dict[str, Exporter] = {
    "colmap": Exporter(write_colmap, needs_images=True),
    "nerfstudio": Exporter(write_nerfstudio, needs_images=True, require=import_open3d),
    "tum": Exporter(write_tum_folder),
    "kitti": Exporter(write_kitti_folder),
    "ply": Exporter(write_ply_folder, require=import_open3d),
    "rrd": Exporter(write_rrd, needs_images=True, require=import_rerun),
    "uni4d": Exporter(write_uni4d_results, needs_images=True, require=import_open3d),
}


def exporter(name: str) -> Exporter:
    """Return the exporter of a format. Raises InputError if there is none of that name."""
    if name not in FORMATS:
        raise InputError(f"unknown format '{name}'; choose among {', '.join(FORMATS)}")
    return FORMATS[name]
