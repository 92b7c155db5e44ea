"""Results in the formats of other programs: COLMAP, nerfstudio, TUM, KITTI, PLY, rerun and Uni4D."""

from uni4d_fg.results.export.model import ExportOptions, ExportReport
from uni4d_fg.results.export.run import export_run

__all__ = ["ExportOptions", "ExportReport", "export_run"]
