"""Results in the formats of other programs: COLMAP, nerfstudio, splatting, TUM, KITTI, PLY, glTF, rerun and Uni4D."""

from uni4d_fg.results.export.model import ExportOptions, ExportReport
from uni4d_fg.results.export.run import export_run

__all__ = ["ExportOptions", "ExportReport", "export_run"]
