"""The verb ``export``."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from uni4d_fg.cli import options
from uni4d_fg.cli.console import print_json
from uni4d_fg.cli.interruption import Interruption
from uni4d_fg.cli.progress import progress_reporter
from uni4d_fg.cli.runs import stored_input


class FormatChoice(str, Enum):
    """Formats of other programs."""

    colmap = "colmap"
    nerfstudio = "nerfstudio"
    gsplat = "gsplat"
    tum = "tum"
    kitti = "kitti"
    ply = "ply"
    ply_frames = "ply-frames"
    mesh = "mesh"
    exr = "exr"
    glb = "glb"
    rrd = "rrd"
    uni4d = "uni4d"


def export(
    run: options.RunPath,
    to: Annotated[list[FormatChoice], typer.Option("--to", help="Format; may be repeated.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option(help="Folder that gets one folder per format; RUN/export if not given.")
    ] = None,
    sequence: Annotated[Path | None, typer.Option(help="The run's sequence, if it was moved.")] = None,
    masks: Annotated[bool, typer.Option(help="colmap, nerfstudio, gsplat: hide what moves.")] = True,
    depth: Annotated[bool, typer.Option("--depth", help="colmap, nerfstudio, gsplat: dense depth too.")] = False,
    normals: Annotated[bool, typer.Option("--normals", help="nerfstudio: normals of the dense depth too.")] = False,
    text: Annotated[bool, typer.Option(help="colmap, gsplat: the model as text too.")] = True,
    trajectories: Annotated[bool, typer.Option("--trajectories", help="ply: trajectories, camera path too.")] = False,
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Frames, masks and depth without lens distortion, with a pinhole.")
    ] = False,
    trail: Annotated[int, typer.Option(help="rrd: past frames that a trajectory shows.", min=1)] = 10,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
    json: options.Json = False,
) -> None:
    """Write a run in the formats of other programs."""
    from uni4d_fg.frontend.sequence.model import Sequence
    from uni4d_fg.results.export import ExportOptions, export_run
    from uni4d_fg.results.run import Run
    from uni4d_fg.results.run_contents import COMMAND_LINE
    from uni4d_fg.results.shot_list import refuse_split

    refuse_split(run)

    def open_sequence() -> Sequence:
        stored = stored_input(run)
        return (stored if sequence is None else stored.moved_to(sequence)).read()

    choices = ExportOptions(
        masks=masks,
        depth=depth,
        normals=normals,
        text=text,
        trajectories=trajectories,
        trail=trail,
        undistort=undistort or normals,
    )
    with progress_reporter(quiet or json) as reporter, Interruption() as stop:
        reports = export_run(
            Run(run, open_sequence), [choice.value for choice in to], out, choices,
            overwrite=overwrite, reporter=reporter, should_stop=stop, remedies=COMMAND_LINE,
        )  # fmt: skip
    if json:
        print_json({r.format: {"folder": r.folder, **r.figures, "warnings": r.warnings} for r in reports})
        return
    for report in reports:
        typer.echo(f"{report.format}: {report.folder}")
        for line in report.facts:
            typer.echo(f"    {line}")
        for warning in report.warnings:
            typer.echo(f"warning: {report.format}: {warning}", err=True)
