"""Pictures of an experiment: camera paths and depth of all methods, and where the time goes."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

from uni4d_fg.frontend.datasets.registry import find_dataset
from uni4d_fg.pipeline.benchmark.table import Table
from uni4d_fg.pipeline.compare.plots import draw_depths, draw_paths, style_panel
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.io import load_reconstruction
from uni4d_fg.results.pictures.figure import INK, new_figure, save_figure
from uni4d_fg.results.run_folder import RunFolder

_STAGES = matplotlib.colormaps["tab10"]


def draw_video(folder: Path, root: Path, dataset: str, video: str, runs: dict[str, Path]) -> list[Path]:
    """Draw the camera paths of all runs of a video, and their depth, under its true depth where that is known.

    Args:
        folder: Where the pictures go.
        root: Folder of the dataset.
        dataset: Its name.
        video: Its name.
        runs: Folder of the run by method.

    Returns:
        The files.

    Raises:
        InputError: If the video or a run cannot be read.
        OutputError: If a file cannot be written.
    """
    opened = find_dataset(dataset).open(root, video)
    truth = opened.ground_truth
    poses = {name: load_reconstruction(RunFolder(run).reconstruction).world_T_cam for name, run in runs.items()}
    files = [folder / f"{video}-path.png"]
    draw_paths(files[0], poses, truth.world_T_cam)
    depths = {name: read_depth(RunFolder(run).depth) for name, run in runs.items()}
    rows = depths if truth.depths is None else {"true depth": truth.depths, **depths}
    files.append(folder / f"{video}-depth.png")
    draw_depths(files[1], opened.images, rows)
    return files


def draw_runtime(path: Path, table: Table) -> Path:
    """Draw the mean seconds per stage as stacked bars, one per method; PNG.

    Args:
        path: The file.
        table: Of :func:`~uni4d_fg.pipeline.benchmark.tables.runtime_table`.

    Raises:
        OutputError: If the file cannot be written.
    """
    names = [column.name for column in table.columns]
    stages = names[: names.index("all")]
    rows = [row for row in table.rows if row.values.get("all") is not None]
    figure = new_figure(9.0, 1.2 + 0.45 * max(len(rows), 1))
    panel = figure.add_subplot(1, 1, 1)
    style_panel(panel, "Runtime per video, mean", "wall time [s]", "")
    left = np.zeros(len(rows))
    for number, stage in enumerate(stages):
        widths = np.array([float(row.values.get(stage) or 0.0) for row in rows])
        if widths.any():
            panel.barh(
                [row.name for row in rows], widths, left=left, color=_STAGES(number % 10), height=0.6, label=stage
            )
        left += widths
    panel.invert_yaxis()
    panel.legend(frameon=False, fontsize=8, labelcolor=INK, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.25))
    save_figure(path, figure)
    return path
